"""What one ``learn`` was asked to do, and how far it has come: what a checkpoint needs to know to go on with it."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rejeu.validation import number, whole


@dataclass
class Call:
    """One call of ``learn``. Mutable: ``logged`` moves on."""

    n_steps: int | None
    """Environment steps to take, None where something else ends it."""
    n_episodes: int | None
    """Episodes to finish, likewise."""
    seconds: float | None
    """Wall time to take, likewise."""
    first_step: int
    """Environment steps taken in all when it began."""
    first_episode: int
    """Episodes finished in all when it began."""
    log_interval: int
    """Episodes between two rows of statistics."""
    logged: int
    """Episodes in the history when the last row was written."""
    steps_before: int = 0
    """Environment steps that schedules count as taken before it: those since the last ``learn`` that began to count."""
    episodes_before: int = 0
    """Episodes likewise."""
    seconds_before: float = 0.0
    """Training time likewise."""
    spent: float = 0.0
    """Wall time that it had taken when it was last taken up, in seconds."""
    began: float = dataclasses.field(default_factory=time.perf_counter)
    """When it was begun or last taken up, by ``time.perf_counter``."""

    @property
    def elapsed(self) -> float:
        """Wall time that it has taken, interruptions left out, in seconds."""
        return self.spent + time.perf_counter() - self.began

    @property
    def last_step(self) -> int | None:
        """Environment steps taken in all when it will be over, None where something else ends it."""
        return None if self.n_steps is None else self.first_step + self.n_steps

    def progress(self, step: int, episode: int) -> float:
        """Returns the progress of schedules, in [0, 1], when so many steps and episodes have passed in all.

        As in Stable-Baselines3, what came before counts as done, and as part of the whole: with 100 steps before and 300
        to take, progress goes from 0.25 to 1. Of several limits the nearest counts.
        """
        by_steps = share(self.steps_before, step - self.first_step, self.n_steps)
        by_episodes = share(self.episodes_before, episode - self.first_episode, self.n_episodes)
        by_time = share(self.seconds_before, self.elapsed, self.seconds)
        return min(max(by_steps, by_episodes, by_time), 1.0)

    def is_over(self, step: int, episode: int) -> bool:
        """Returns whether one of its limits is reached."""
        by_steps = self.last_step is not None and step >= self.last_step
        by_episodes = self.n_episodes is not None and episode - self.first_episode >= self.n_episodes
        return by_steps or by_episodes or (self.seconds is not None and self.elapsed >= self.seconds)

    def to_json(self) -> dict[str, Any]:
        """Returns it as plain JSON values."""
        return {**{key: getattr(self, key) for key in SAVED}, "spent": self.elapsed}

    @classmethod
    def from_json(cls, saved: Mapping[str, Any]) -> Call:
        """Returns what :meth:`to_json` did, taken up now.

        Raises:
            KeyError, ValueError: if it is damaged.
        """
        steps, episodes, seconds = (saved[key] for key in ("n_steps", "n_episodes", "seconds"))
        return cls(
            n_steps=None if steps is None else whole("n_steps", steps, least=1),
            n_episodes=None if episodes is None else whole("n_episodes", episodes, least=1),
            seconds=None if seconds is None else number("seconds", seconds, above=0),
            first_step=whole("first_step", saved["first_step"], least=0),
            first_episode=whole("first_episode", saved["first_episode"], least=0),
            log_interval=whole("log_interval", saved["log_interval"], least=0),
            logged=whole("logged", saved["logged"], least=0),
            steps_before=whole("steps_before", saved.get("steps_before", 0), least=0),
            episodes_before=whole("episodes_before", saved.get("episodes_before", 0), least=0),
            seconds_before=number("seconds_before", saved.get("seconds_before", 0.0), least=0),
            spent=number("spent", saved["spent"], least=0),
        )


def share(before: float, taken: float, limit: float | None) -> float:
    """Returns which share of ``before + limit`` is done once ``taken`` more have passed; 0 without a limit.

    >>> share(100, 0, 300), share(100, 300, 300), share(100, 50, None)
    (0.25, 1.0, 0.0)
    """
    return 0.0 if limit is None else (before + taken) / (before + limit)


SAVED = [field.name for field in dataclasses.fields(Call) if field.name not in ("spent", "began")]
