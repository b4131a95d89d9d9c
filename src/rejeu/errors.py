"""The errors that are rejeu's own. Everything else that a user may meet is a ``ValueError`` or a ``TypeError``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


class MissingExtra(ImportError):
    """An optional package is not installed; the message holds the command that installs it."""

    def __init__(self, purpose: str, package: str, extra: str) -> None:
        super().__init__(f"{purpose} needs {package}, which is not installed; run: pip install 'rejeu[{extra}]'")


class CheckpointError(ValueError):
    """A file could not be read as what it was asked to be; the message says what differs."""


class BadEnvironmentError(RuntimeError):
    """An environment returned something that nothing can be learnt from."""


class NonFiniteError(RuntimeError):
    """Learning met a number that is NaN or infinite, and stopped; the message says what, where and what may help."""

    def __init__(
        self, message: str, *, names: Sequence[str] = (), step: int = 0, n_updates: int = 0, batch: Path | None = None
    ) -> None:
        super().__init__(message)
        self.names = tuple(names)
        """What was not finite: losses, and leaves of the state by dotted path."""
        self.step = step
        """Environment steps taken when the update was started."""
        self.n_updates = n_updates
        """Gradient steps taken in all."""
        self.batch = batch
        """The file that holds the batch, None where there is none."""


class WorkerError(RuntimeError):
    """A worker process failed; the message holds the traceback from there, where there is one."""


class RunInUseError(RuntimeError):
    """Another process is training in the folder of a run."""
