"""Runs as processes of this machine. This module is imported on the nodes of a cluster, so it does not import JAX."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from rejeu.core import atomic, hardware, interrupt

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
TAIL = 2**16
"""Most bytes of a log that are read."""
LOST = -1
"""Exit status of a process that vanished."""


class Process:
    """A process that trains, supervised by this one: it stops, with a checkpoint, when this one does. Mutable."""

    def __init__(self, task: Path, log: Path, environ: dict[str, str], folder: Path | None = None) -> None:
        """Starts it.

        Args:
            task: file with what it is asked to do.
            log: file to which what it prints is appended.
            environ: its environment variables.
            folder: its current folder; None for that of this process.

        Raises:
            OSError: if the log cannot be written.
        """
        with atomic.open_file(log) as file:
            self._process = subprocess.Popen(
                program(task),
                stdin=subprocess.PIPE,
                stdout=file,
                stderr=subprocess.STDOUT,
                cwd=folder,
                env={**environ, interrupt.SUPERVISED: "1"},
                process_group=0 if os.name == "posix" else None,  # Ctrl-C reaches it once, through stop
                creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
            )

    def poll(self) -> int | None:
        """Returns the exit status, negative if a signal ended it; None while it runs."""
        status = self._process.poll()
        if status is not None:
            self.stop()
        return status

    def stop(self) -> None:
        """Asks it to stop after the current step, with a checkpoint."""
        if self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()

    def kill(self) -> None:
        """Ends it at once and waits for its end."""
        self._process.kill()
        self._process.wait()
        self.stop()


def program(task: Path) -> list[str]:
    """Returns the command line of a process that does what the file of a task says."""
    return interrupt.program("-m", "rejeu", "--task", str(task))


APART: dict[str, Any] = {"creationflags": 0x8000200} if sys.platform == "win32" else {"start_new_session": True}
"""Options of a process that no signal to this one reaches; on Windows it is a process group with a hidden console of its own,
so that no window opens for each of the programs that it starts, such as workers and ffmpeg."""


def start_apart(words: Sequence[str], log: Path) -> subprocess.Popen[bytes]:
    """Starts the command ``rejeu`` with these words, which goes on when this process ends; ``log`` gets what it prints.

    Raises:
        OSError: if the log cannot be written, such as a symbolic link.
    """
    with atomic.open_file(log) as output:
        command = interrupt.program("-m", "rejeu", *words)
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, **APART)


def last_line(log: Path) -> str:
    """Returns the last line of a log that is not empty."""
    try:
        text = end_of(log).strip().rpartition("\n")[2].strip()
    except OSError:
        return "there is no log"
    return text.removeprefix("rejeu: error: ") or "it printed nothing"


def end_of(log: Path) -> str:
    """Returns the last :data:`TAIL` bytes of a log as text."""
    with log.open("rb") as file:
        file.seek(max(log.stat().st_size - TAIL, 0))
        return file.read(TAIL).decode("utf-8", "replace")


def default_workers() -> int:
    """Returns how many runs are trained at once: half as many as there are cores."""
    return max(hardware.cores() // 2, 1)


def threads_of(workers: int) -> int:
    """Returns the threads of each of so many runs, so that they do not slow each other."""
    return max(hardware.cores() // workers, 1)


class LocalLauncher:
    """Starts runs on this machine."""

    def __init__(self, workers: int, threads: int | None = None) -> None:
        """Starts nothing; each of the ``workers`` runs at once has so many threads, by default its share of the cores."""
        self.capacity = workers
        n_threads = str(threads or threads_of(workers))
        self._environ = {**dict.fromkeys(THREADS, n_threads), **os.environ, hardware.CORES: n_threads}

    def start(self, task: Path, log: Path) -> Process:
        """Starts a run."""
        return Process(task, log, self._environ)

    def close(self) -> None:
        """Does nothing: the processes end with this one."""


def hold(path: Path) -> FileLock | None:
    """Returns the lock on a file, held by this process; None if another process holds it."""
    atomic.make_folder(path.parent)
    lock = atomic.lock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return None
    return lock
