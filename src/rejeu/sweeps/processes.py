"""Runs as processes on this machine."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from rejeu import xla
from rejeu.sweeps.process import Process

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def default_workers() -> int:
    """Returns how many runs are trained at once: half as many as there are cores."""
    return max(xla.cores() // 2, 1)


def threads_of(workers: int) -> int:
    """Returns the threads of each of so many runs, so that they do not slow each other."""
    return max(xla.cores() // workers, 1)


def environment(threads: int) -> dict[str, str]:
    """Returns the environment variables of a process that uses so many threads."""
    found = {**os.environ, **{name: os.environ.get(name, str(threads)) for name in THREADS}}
    return {**found, xla.CORES: str(threads)}


class LocalLauncher:
    """Starts runs on this machine."""

    def __init__(self, workers: int, threads: int) -> None:
        self.capacity = workers
        """Runs at once."""
        self._environ = environment(threads)

    def start(self, words: Sequence[str], run: Path, log: Path, lock: Path) -> Process:
        """Starts a run; ``run`` is its folder."""
        return Process(words, log, lock, self._environ)

    def close(self) -> None:
        """Does nothing: the processes end with this one."""
