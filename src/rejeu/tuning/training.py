"""Trainings of a study: one process of ``rejeu train`` each, with a run folder of its own."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rejeu.reporting.runs import EVALUATIONS, read_run
from rejeu.reporting.tables import read_table
from rejeu.sweeps.process import Process, last_line


@dataclass(frozen=True)
class Command:
    """What all command lines of a study have in common."""

    env: str
    """The environment as typed."""
    options: tuple[str, ...]
    """Further words: keyword arguments, wrappers and imports."""
    environ: dict[str, str]
    """Environment variables."""

    def train(self, preset: Path, seed: int, path: Path, checkpoint_minutes: float) -> list[str]:
        """Returns the words after ``rejeu`` that begin a training."""
        words = ["train", self.env, "--preset", str(preset), "--seed", str(seed), "--out", str(path), *self.options]
        return [*words, *QUIET, "--checkpoint-minutes", str(checkpoint_minutes)]

    def resume(self, path: Path) -> list[str]:
        """Returns the words after ``rejeu`` that continue a training."""
        return ["resume", str(path), "--finish", "--env", self.env, *self.options, *QUIET]


QUIET = ("--no-report", "--no-video")


def env_options(
    kwargs: Mapping[str, Any], wrappers: Iterable[str] = (), imports: Iterable[str] = ()
) -> tuple[str, ...]:
    """Returns the words of a command line that make an environment like that of the study.

    >>> env_options({"map_name": "8x8"}, ["my_env:Shaped"])
    ('--env-kwargs', 'map_name="8x8"', '--wrapper', 'my_env:Shaped')
    """
    words = ["--env-kwargs"] if kwargs else []
    words += [f"{name}={json.dumps(value)}" for name, value in kwargs.items()]
    for option, names in (("--wrapper", wrappers), ("--import", imports)):
        words += [word for name in names for word in (option, name)]
    return tuple(words)


def settings_options(hyperparameters: Mapping[str, Any]) -> list[str]:
    """Returns the words of a command line that set hyperparameters.

    >>> settings_options({"gamma": 0.9})
    ['--set', 'gamma=0.9']
    """
    return ["--set", *(f"{name}={json.dumps(value)}" for name, value in hyperparameters.items())]


class Training:
    """One training. Mutable."""

    def __init__(self, path: Path, seed: int, preset: Path) -> None:
        self.path, self.seed, self.preset = path, seed, preset
        self.log = path.with_name(f"{path.name}.log")
        self.process: Process | None = None
        self.status: int | None = None
        """Exit status; None before the end."""

    def start(self, command: Command, checkpoint_minutes: float) -> None:
        """Starts the process, or continues an interrupted training; one that is finished is not repeated."""
        if self.is_finished():
            self.status = 0
            return
        if (self.path / "checkpoints").is_dir() and any((self.path / "checkpoints").iterdir()):
            words = command.resume(self.path)
        else:
            if self.path.exists():
                shutil.rmtree(self.path)  # it was killed before its first checkpoint
            words = command.train(self.preset, self.seed, self.path, checkpoint_minutes)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.process = Process(words, self.log, self.path.with_name(f"{self.path.name}.lock"), command.environ)

    def is_finished(self) -> bool:
        """Returns whether the run has reached its goal."""
        try:
            return read_run(self.path).state == "finished"
        except OSError:
            return False

    def has_ended(self) -> bool:
        """Returns whether the process has ended, and keeps its exit status."""
        if self.process is not None and self.status is None:
            self.status = self.process.poll()
        return self.status is not None

    def evaluations(self, column: str) -> list[tuple[int, float]]:
        """Returns step and value of each evaluation so far."""
        try:
            table = read_table(self.path / EVALUATIONS)
        except OSError:
            return []
        return list(zip(table.column("step").astype(int).tolist(), table.column(column).tolist(), strict=True))

    def stop(self) -> None:
        """Asks the process to stop after the current step, with a checkpoint."""
        if self.process is not None:
            self.process.stop()

    def kill(self) -> None:
        """Ends the process at once."""
        if self.process is not None and self.process.poll() is None:
            self.process.kill()

    def drop_checkpoints(self) -> None:
        """Deletes the checkpoints, which hold the replay buffer."""
        shutil.rmtree(self.path / "checkpoints", ignore_errors=True)

    def last_line(self) -> str:
        """Returns the last line of the log."""
        return last_line(self.log).removeprefix("rejeu: error: ")
