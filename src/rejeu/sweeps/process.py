"""A run as a process. This module is imported on the nodes of a cluster, so it does not import JAX."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from rejeu import supervised
from rejeu.io import atomic

LOST = -1
"""Exit status of a process that vanished."""


class Process:
    """A process that trains, supervised by this one: it stops, with a checkpoint, when this one does. Mutable."""

    def __init__(
        self, words: Sequence[str], log: Path, lock: Path, environ: dict[str, str], folder: Path | None = None
    ) -> None:
        """Starts it.

        Args:
            words: command line after ``rejeu``.
            log: file to which what it prints is appended.
            lock: file that it keeps locked while it lives.
            environ: its environment variables.
            folder: its current folder; None for that of this process.

        Raises:
            OSError: if the log cannot be written.
        """
        with atomic.open_log(log) as file:
            self._process = subprocess.Popen(
                program(words),
                stdin=subprocess.PIPE,
                stdout=file,
                stderr=subprocess.STDOUT,
                cwd=folder,
                env={**environ, supervised.LOCK: str(lock)},
                process_group=0 if os.name == "posix" else None,  # Ctrl-C reaches it once, through stop
            )

    @property
    def pid(self) -> int:
        """Id of the process."""
        return self._process.pid

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


def program(words: Sequence[str]) -> list[str]:
    """Returns the command line of a process."""
    return [sys.executable, "-m", "rejeu", *words]


def last_line(log: Path) -> str:
    """Returns the last line of a log that is not empty."""
    try:
        with log.open("rb") as file:
            file.seek(max(log.stat().st_size - 4096, 0))
            lines = file.read().decode("utf-8", "replace").split("\n")
    except OSError:
        return "there is no log"
    return next((line.strip() for line in reversed(lines) if line.strip()), "it printed nothing")
