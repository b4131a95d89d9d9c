"""One call of ``learn``: its limits, and how far it has come. A checkpoint contains it, so that training can resume."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rejeu.io.records import Count, Duration, Positive, Seconds, convert
from rejeu.validation import number, whole


@dataclass
class TrainingCall:
    """One call of ``learn``. Mutable: ``logged`` is updated with each row of statistics."""

    n_steps: Positive | None
    """Environment steps to take; None for no such limit."""
    n_episodes: Positive | None
    """Episodes to finish; None for no such limit."""
    seconds: Duration | None
    """Wall time to take, in seconds; None for no such limit."""
    first_step: Count
    """Total environment steps when it started."""
    first_episode: Count
    """Total finished episodes when it started."""
    log_interval: Count
    """Episodes between two rows of statistics."""
    logged: Count
    """Episodes in the history when the last row was written."""
    steps_before: Count = 0
    """Environment steps before it that schedules count: those since the last ``learn`` that reset the counters."""
    episodes_before: Count = 0
    """Episodes before it that schedules count."""
    seconds_before: Seconds = 0.0
    """Training time before it that schedules count, in seconds."""
    spent: Seconds = 0.0
    """Wall time it had taken before it was last resumed, in seconds."""
    began: float = dataclasses.field(default_factory=time.perf_counter)
    """When it was started or last resumed, by ``time.perf_counter``."""

    @property
    def elapsed(self) -> float:
        """Wall time it has taken, without interruptions, in seconds."""
        return self.spent + time.perf_counter() - self.began

    @property
    def last_step(self) -> int | None:
        """Total environment steps at which it ends; None if it has no limit of steps."""
        return None if self.n_steps is None else self.first_step + self.n_steps

    def progress(self, step: Any, episode: int) -> Any:
        """Returns the progress of schedules, in [0, 1], after ``step`` environment steps and ``episode`` episodes in total.

        ``step`` is a number, or an array of numbers, each of which gets its own progress.

        As in Stable-Baselines3, earlier steps count as done and as part of the total: with 100 steps before and 300 to
        take, progress goes from 0.25 to 1. With several limits the nearest one counts.
        """
        by_steps = share(self.steps_before, step - self.first_step, self.n_steps)
        by_episodes = share(self.episodes_before, episode - self.first_episode, self.n_episodes)
        by_time = share(self.seconds_before, self.elapsed, self.seconds)
        others = max(by_episodes, by_time)
        if isinstance(by_steps, np.ndarray):
            return np.minimum(np.maximum(by_steps, others), 1.0)
        return min(max(by_steps, others), 1.0)

    def is_over(self, step: int, episode: int) -> bool:
        """Returns whether one of its limits is reached."""
        by_steps = self.last_step is not None and step >= self.last_step
        by_episodes = self.n_episodes is not None and episode - self.first_episode >= self.n_episodes
        return by_steps or by_episodes or (self.seconds is not None and self.elapsed >= self.seconds)

    def to_json(self) -> dict[str, Any]:
        """Returns it as JSON values."""
        return {**{key: getattr(self, key) for key in SAVED}, "spent": self.elapsed}

    @classmethod
    def from_json(cls, saved: Mapping[str, Any]) -> TrainingCall:
        """Returns the call that :meth:`to_json` saved, resumed now.

        Raises:
            CheckpointError: if the values are damaged.
        """
        call = convert(saved, cls)
        call.began = time.perf_counter()
        return call


SAVED = [field.name for field in dataclasses.fields(TrainingCall) if field.name not in ("spent", "began")]


def checked_limits(
    total_timesteps: int | None, episodes: int | None, minutes: float | None
) -> tuple[int | None, int | None, float | None]:
    """Returns the limits of a ``learn``, as users give them, as numbers of steps, episodes and seconds.

    Raises:
        ValueError: if one is not a positive number.
    """
    return (
        None if total_timesteps is None else whole("total_timesteps", total_timesteps, least=1),
        None if episodes is None else whole("episodes", episodes, least=1),
        None if minutes is None else 60 * number("minutes", minutes, above=0),
    )


def share(before: float, taken: Any, limit: float | None) -> Any:
    """Returns the share of ``before + limit`` that is done after ``taken`` more; 0 without a limit.

    >>> share(100, 0, 300), share(100, 300, 300), share(100, 50, None)
    (0.25, 1.0, 0.0)
    """
    return 0.0 if limit is None else (before + taken) / (before + limit)
