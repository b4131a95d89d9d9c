"""Trainings of a study: one process of ``rejeu train`` each, with a run folder of its own."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from rejeu.agents.run_files import newest_step
from rejeu.experiments.scheduler import Work
from rejeu.reporting.runs import EVALUATIONS, read_run
from rejeu.reporting.tables import read_table
from rejeu.runs.config import RunConfig
from rejeu.runs.task import Task


def begin_or_resume(folder: Path, run: RunConfig, **more: Any) -> Task:
    """Returns what begins a run in a folder, or continues it from its newest checkpoint; ``more`` is for both."""
    resume = newest_step(folder / "checkpoints") >= 0
    if not resume and folder.exists():
        shutil.rmtree(folder)  # it was killed before its first checkpoint
    folder.parent.mkdir(parents=True, exist_ok=True)
    return Task(folder=str(folder), run=run, resume=resume, no_report=True, no_video=True, **more)


class Training(Work):
    """One training. Mutable."""

    def __init__(self, run: RunConfig, path: Path, seed: int, preset: Path, claim: Path | None = None) -> None:
        """Starts nothing.

        Args:
            run: what all trainings of the study have in common.
            path: its run folder.
            seed: of the training.
            preset: file with its hyperparameters.
            claim: file that is locked by the process that looks after it; None if that process holds another lock.
        """
        self.config, self.seed, self.claim = replace(run, preset=str(preset), seed=seed), seed, claim
        self.name = f"{path.parent.name}, seed {seed}"
        self.run, self.log, self.lock = (path.with_name(f"{path.name}{end}") for end in ("", ".log", ".lock"))

    def task(self) -> Task:
        return begin_or_resume(self.run, self.config)

    def has_result(self) -> bool:
        try:
            return read_run(self.run).state == "finished"
        except OSError:
            return False

    def is_open(self) -> bool:
        return not self.has_result()

    def ended(self) -> None:
        """Deletes the checkpoints, which hold the replay buffer, once it is done."""
        if self.ending == "done":
            self.drop_checkpoints()

    def evaluations(self, column: str) -> list[tuple[int, float]]:
        """Returns step and value of each evaluation so far."""
        try:
            table = read_table(self.run / EVALUATIONS)
        except OSError:
            return []
        return list(zip(table.column("step").astype(int).tolist(), table.column(column).tolist(), strict=True))

    def drop_checkpoints(self) -> None:
        """Deletes the checkpoints."""
        shutil.rmtree(self.run / "checkpoints", ignore_errors=True)
