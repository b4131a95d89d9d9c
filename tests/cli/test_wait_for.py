"""``rejeu train --wait-for``: results as they arrive, in a run folder."""

from __future__ import annotations

import numpy as np
import pytest
from safetensors.numpy import load_file

from rejeu import cli
from rejeu.errors import CheckpointError
from rejeu.runs import folder as run_folder
from rejeu.runs.folder import RunFolder

SHORT = [
    "--algo=SAC", "--envs=3", "--backend=gymnasium-async", "--seed=0", "--no-report", "--no-video",
    "--evaluate-episodes=1", "--set", "policy_kwargs.net_arch=[8]", "batch_size=4", "learning_starts=8",
]  # fmt: skip


def train(out, *words, steps=30):
    assert cli.main(["train", "Pendulum-v1", f"--steps={steps}", f"--out={out}", "--wait-for=2", *words, *SHORT]) == 0
    return load_file(out / "agent.safetensors")


def test_a_run_repeats_from_the_file_with_its_order_of_arrival(tmp_path):
    first = train(tmp_path / "one")
    arrivals = run_folder.read_arrivals(tmp_path / "one" / "arrivals.npy")
    assert arrivals.shape == (15, 2)
    assert run_folder.read_config(RunFolder(tmp_path / "one")).wait_for == 2
    second = train(tmp_path / "two", f"--arrivals={tmp_path / 'one' / 'arrivals.npy'}")
    np.testing.assert_array_equal(run_folder.read_arrivals(tmp_path / "two" / "arrivals.npy"), arrivals)
    for name, array in first.items():
        np.testing.assert_array_equal(array, second[name])
    assert cli.main(["resume", str(tmp_path / "two"), "--steps=10", "--no-report", "--no-video"]) == 0
    longer = run_folder.read_arrivals(tmp_path / "two" / "arrivals.npy")
    assert longer.shape == (20, 2)
    np.testing.assert_array_equal(longer[:15], arrivals)


def test_other_files_are_no_order_of_arrival(tmp_path):
    path = tmp_path / "arrivals.npy"
    np.save(path, np.array([{}], object))
    with pytest.raises(CheckpointError, match=r"is not the arrivals\.npy of a run: .*pickle"):
        run_folder.read_arrivals(path)
    np.save(path, np.zeros((3, 2), np.uint16))
    whole = path.read_bytes()
    huge = whole.replace(b"(3, 2), }", b"(9999999999999, 2), }")
    for content in (b"", b"PK\3\4" + whole, whole[:-1], huge[:128]):
        path.write_bytes(content)
        with pytest.raises(CheckpointError, match="is not the arrivals"):
            run_folder.read_arrivals(path)
