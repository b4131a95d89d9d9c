"""``rejeu train --wait-for``: results as they arrive, in a run folder."""

from __future__ import annotations

from rejeu.checkpoints.run_folder import RunFolder
from rejeu.lab import cli
from rejeu.lab.runs.config import read_folder
from tests.tiers import exhaustive

SHORT = [
    "--algo=SAC", "--envs=3", "--backend=gymnasium-async", "--seed=0", "--no-report", "--no-video",
    "--evaluate-episodes=1", "--set", "policy_kwargs.net_arch=[8]", "batch_size=4", "learning_starts=8",
]  # fmt: skip


@exhaustive
def test_a_run_that_waits_for_some_environments_is_resumed(tmp_path):
    out = tmp_path / "run"
    assert cli.main(["train", "Pendulum-v1", "--steps=30", f"--out={out}", "--wait-for=2", *SHORT]) == 0
    assert read_folder(RunFolder(out)).wait_for == 2
    assert cli.main(["resume", str(out), "--steps=10", "--no-report", "--no-video"]) == 0
