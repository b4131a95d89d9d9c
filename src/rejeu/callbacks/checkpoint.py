"""Checkpoints of the whole run in the course of training."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, ClassVar

import jax

from rejeu.callbacks.base import TrainingCallback, crossed
from rejeu.core.errors import NonFiniteError
from rejeu.core.validation import as_path, number, whole
from rejeu.training.run import Progress

MINUTES = 5.0
"""Wall time between two checkpoints by default."""


class Checkpoint(TrainingCallback):
    """Saves the whole run at intervals of environment steps or minutes, and at the end of ``learn``, so that it can resume.

    Ctrl-C, SIGTERM and errors of the environment end ``learn`` with a checkpoint as well. ``Agent.resume(folder)`` resumes
    the run. The folder belongs to one run; the last ``keep`` checkpoints are kept.

    >>> import rejeu, tempfile
    >>> folder = tempfile.mkdtemp()
    >>> agent = rejeu.SAC("MlpPolicy", "rejeu/Ball-v0", seed=0, buffer_size=1000)
    >>> stop = lambda agent, progress: progress.step < 150
    >>> _ = agent.learn(300, [Checkpoint(folder, every=100), stop])
    >>> rejeu.SAC.resume(folder).learn().num_timesteps
    300
    """

    runs_last: ClassVar[bool] = True

    def __init__(
        self, folder: str | Path, every: int | None = None, *, minutes: float | None = None, keep: int = 2
    ) -> None:
        """Saves nothing yet.

        Args:
            folder: of the checkpoints, made with the first; new, or of the same run.
            every: environment steps between two checkpoints.
            minutes: wall time between two checkpoints; if neither is given, five.
            keep: how many checkpoints are kept, at least 1.
        """
        if isinstance(folder, int):
            raise TypeError(f"folder={folder!r} must be a path: Checkpoint(folder, every={folder})")
        self.folder = as_path(folder)
        self.every = None if every is None else whole("every", every, least=1)
        checked_minutes = None if minutes is None else number("minutes", minutes, above=0)
        self.minutes = MINUTES if checked_minutes is None and every is None else checked_minutes
        self.keep = whole("keep", keep, least=1)
        self.seconds = 0.0
        """Wall time spent saving."""
        self._run_folder: Any = None
        self._saved: tuple[int, int] | None = None
        self._last_step = 0
        self._last_time = 0.0

    def before_training(self, agent: Any) -> None:
        """Locks the folder, and saves at once if it contains no checkpoint.

        Raises:
            RunInUseError: if another process trains there.
            FileExistsError: if it contains the checkpoints of another run.
        """
        folder = agent.checkpoint_folder(self.folder)
        folder.open()
        self._run_folder = folder
        self._last_step, self._last_time = agent.run.step, time.monotonic()
        if folder.is_empty():
            self.save(agent)

    def __call__(self, agent: Any, progress: Progress) -> None:
        """Saves if a checkpoint is due."""
        before, self._last_step = self._last_step, progress.step
        by_steps = self.every is not None and crossed(before, progress.step, self.every)
        now = time.monotonic()
        by_time = self.minutes is not None and now - self._last_time >= 60 * self.minutes
        if by_steps or by_time:
            self._attempt(agent)

    def after_training(self, agent: Any, error: BaseException | None) -> None:
        """Saves and releases the folder. After an error that leaves numbers that are not finite, nothing is saved."""
        try:
            if error is None:
                self._attempt(agent)
            elif isinstance(error, Exception) and not isinstance(error, NonFiniteError):
                self._save_after(error, agent)
        finally:
            if self._run_folder is not None:
                self._run_folder.close()

    def save(self, agent: Any, reason: str = "") -> Path | None:
        """Saves now, unless nothing has happened since the last time; returns the path, or None.

        Args:
            agent: the agent.
            reason: why the environments' state cannot be trusted; empty if it can.

        Raises:
            OSError: if it cannot be written; earlier checkpoints are unchanged.
            NonFiniteError: if the last update left numbers that are not finite; nothing is written then.
        """
        began, run = time.monotonic(), agent.run
        if self._saved == (run.step, run.n_updates) and not reason:
            return None
        path = agent.checkpoint_folder(self.folder).save(self.keep, reason)
        self._saved, self._last_step, self._last_time = (run.step, run.n_updates), run.step, time.monotonic()
        self.seconds += self._last_time - began
        return path

    def _attempt(self, agent: Any, reason: str = "") -> None:
        """Saves; if that fails, warns, and the next checkpoint makes up for it."""
        if not agent.failed_writes.attempt(f"checkpoints in {self.folder}", lambda: self.save(agent, reason)):
            self._last_time = time.monotonic()

    def _save_after(self, error: Exception, agent: Any) -> None:
        """Saves what is intact after an error within a step: the resumed run starts with new episodes."""
        if any(array.is_deleted() for array in jax.tree.leaves(agent.run.state)):
            return  # the error came between two states
        try:
            self._attempt(agent, f"the run ended with {type(error).__name__}")
        except Exception as second:  # the user must see the first error
            error.add_note(f"and no checkpoint could be saved: {second}")
