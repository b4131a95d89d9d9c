"""Run folders, sweeps, studies and populations written by earlier code are read, evaluated and resumed.

``tests/data/record.py`` wrote them. The name of the folder is the month of the code.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import rejeu
from rejeu.cli import main
from tests.tiers import exhaustive

FOLDERS = sorted(
    path for path in (Path(__file__).parent / "data").iterdir() if path.is_dir() and path.name[0].isdigit()
)
RUNS = {
    "her": ("parking-v0", 300, 320),
    "recurrent": ("rejeu/CartPoleNoVelocity-v0", 160, 256),
    "prioritized": ("CartPole-v1", 200, 300),
    "device": ("jax/PointMaze-v0", 200, 300),
    "killed": ("Pendulum-v1", None, 60),
}
"""By folder: the environment, the steps of the saved agent, and those after ``MORE``."""
MORE = {"her": ["--steps", "20"], "killed": ["--steps", "40"]}
FEWER_FILES = ["--no-report", "--no-video"]

pytestmark = pytest.mark.usefixtures("learners_are_shared")


@pytest.fixture(params=FOLDERS, ids=lambda path: path.name)
def older(request, tmp_path):
    """A copy of a folder of recorded files."""
    return Path(shutil.copytree(request.param, tmp_path / "runs"))


def read(capsys, *words):
    """Runs a command and returns what it prints with ``--json``."""
    assert main([*map(str, words), "--json"]) in (0, 3, 4)  # 3 and 4: interrupted, crashed
    return json.loads(capsys.readouterr().out)


def steps_of(folder):
    return rejeu.load(folder / "agent.safetensors").num_timesteps


@pytest.mark.parametrize("name", RUNS)
def test_a_run_is_read_evaluated_and_resumed(older, name, capsys):
    folder, (env, steps, afterwards) = older / name, RUNS[name]
    assert read(capsys, "status", folder)["env"] == env
    if steps is not None:
        agent = rejeu.load(folder / "agent.safetensors")
        assert agent.num_timesteps == steps
        before = {key: value.copy() for key, value in agent.get_parameters().items()}
        assert main(["evaluate", str(folder), "--episodes", "1"]) == 0
    assert main(["resume", str(folder), *MORE.get(name, []), *FEWER_FILES]) == 0, capsys.readouterr().err
    assert steps_of(folder) == afterwards
    if steps is not None:
        now = rejeu.load(folder / "agent.safetensors").get_parameters()
        assert before.keys() == now.keys()
        assert any(not np.array_equal(value, now[key]) for key, value in before.items())


def test_all_runs_of_a_folder_are_listed_compared_and_reported(older, capsys, tmp_path):
    listed = read(capsys, "runs", older)["runs"]
    assert len(listed) >= 20
    assert {run["env"] for run in listed} >= {env for env, *_ in RUNS.values()}
    assert main(["compare", str(older / "compared"), "--out", str(tmp_path / "compared.html")]) == 0
    assert main(["report", str(older / "her"), "--out", str(tmp_path / "her.html")]) == 0
    assert all((tmp_path / f"{name}.html").stat().st_size > 10_000 for name in ("compared", "her"))


def test_a_run_of_several_seeds_is_resumed(older):
    runs = sorted(path.parent for path in (older / "seeds").glob("*/config.json"))
    assert len(runs) == 2
    before = steps_of(runs[0])
    assert main(["resume", str(runs[0]), "--steps", "64", *FEWER_FILES]) == 0
    assert steps_of(runs[0]) >= before + 64  # on the device it pauses where a chunk ends


def test_the_preset_of_a_study_is_used(older, tmp_path):
    words = ["train", "CartPole-v1", "--preset", str(older / "compared" / "preset.json"), "--steps", "32"]
    assert main([*words, "--out", str(tmp_path / "run"), *FEWER_FILES, "--evaluate-episodes", "1"]) == 0


@exhaustive
@pytest.mark.parametrize(("name", "complete"), [("sweep", 3), ("study", 3), ("population", 2)])
def test_many_runs_are_resumed(older, name, complete):
    assert main(["resume", str(older / name)]) == 0
    assert len([*(older / name).rglob("agent.safetensors")]) == complete
