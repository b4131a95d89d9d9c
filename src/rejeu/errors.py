"""The errors that are rejeu's own. Everything else that a user may meet is a ``ValueError`` or a ``TypeError``."""

from __future__ import annotations


class MissingExtra(ImportError):
    """An optional package is not installed; the message holds the command that installs it."""

    def __init__(self, purpose: str, package: str, extra: str) -> None:
        super().__init__(f"{purpose} needs {package}, which is not installed; run: pip install 'rejeu[{extra}]'")


class CheckpointError(ValueError):
    """A file could not be read as what it was asked to be; the message says what differs."""


class BadEnvironmentError(RuntimeError):
    """An environment returned something that nothing can be learnt from."""


class WorkerError(RuntimeError):
    """A worker process failed; the message holds the traceback from there, where there is one."""


class RunInUseError(RuntimeError):
    """Another process is training in the folder of a run."""
