"""Trainings of a study: one process of ``rejeu train`` each, with a run folder of its own."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from rejeu import xla
from rejeu.reporting.runs import EVALUATIONS, read_run
from rejeu.reporting.tables import read_table

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
GRACE = 60.0
"""Seconds after which a process that was asked to stop is killed."""


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
        """Returns the command that begins a training."""
        words = ["train", self.env, "--preset", str(preset), "--seed", str(seed), "--out", str(path), *self.options]
        return [*PROGRAM, *words, *QUIET, "--checkpoint-minutes", str(checkpoint_minutes)]

    def resume(self, path: Path) -> list[str]:
        """Returns the command that continues a training."""
        return [*PROGRAM, "resume", str(path), "--env", self.env, *self.options, *QUIET]


PROGRAM = (sys.executable, "-m", "rejeu")
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


def environment(at_once: int) -> dict[str, str]:
    """Returns the environment variables of a process: its share of the cores, so that trainings do not slow each other."""
    share = max(xla.cores() // at_once, 1)
    found = {**os.environ, **{name: os.environ.get(name, str(share)) for name in THREADS}}
    if share == 1:
        found.setdefault(xla.THREADS, "1")
    return found


class Training:
    """One training. Mutable."""

    def __init__(self, path: Path, seed: int, preset: Path) -> None:
        self.path, self.seed, self.preset = path, seed, preset
        self.log = path.with_name(f"{path.name}.log")
        self.process: subprocess.Popen[bytes] | None = None
        self.status: int | None = None
        """Exit status; None before the end."""
        self._deadline = math.inf

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
        with self.log.open("ab") as log:
            self.process = self.spawn(words, log, command.environ)

    def spawn(self, words: list[str], log: IO[bytes], environ: dict[str, str]) -> subprocess.Popen[bytes]:
        """Returns the process of a command, which prints to ``log``."""
        return subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=environ,
            # Ctrl-C reaches it once, through stop; on Windows the console sends it to all processes
            process_group=0 if os.name == "posix" else None,
        )

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
            if self.status is None and time.monotonic() > self._deadline:
                self.process.kill()
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
        if self.process is None or self.process.poll() is not None:
            return
        self._deadline = time.monotonic() + GRACE
        if os.name == "posix":
            self.process.send_signal(signal.SIGINT)
        else:
            self.process.terminate()

    def kill(self) -> None:
        """Ends the process at once."""
        if self.process is not None and self.process.poll() is None:
            self.process.kill()
            self.process.wait()

    def drop_checkpoints(self) -> None:
        """Deletes the checkpoints, which hold the replay buffer."""
        shutil.rmtree(self.path / "checkpoints", ignore_errors=True)

    def last_line(self) -> str:
        """Returns the last line of the log, without what precedes the message."""
        try:
            with self.log.open("rb") as file:
                file.seek(max(self.log.stat().st_size - 4096, 0))
                lines = file.read().decode("utf-8", "replace").split("\n")
        except OSError:
            lines = []
        line = next((line.strip() for line in reversed(lines) if line.strip()), "it printed nothing")
        return line.removeprefix("rejeu: error: ")
