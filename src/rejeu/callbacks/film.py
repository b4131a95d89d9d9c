"""Films of the policy in the course of training."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym

from rejeu.callbacks.base import TrainedAgent
from rejeu.callbacks.due import crossed, step_before
from rejeu.loops.run import Progress
from rejeu.validation import whole

DIGITS = 9
"""Of the step in the name of a film."""


class Film:
    """Films the deterministic policy while it learns, every so many steps or training episodes.

    Each film is ``folder/step_<step>.mp4``, with the step in nine digits, so that names sort by time. It shows an episode
    or more in an environment of its own: training continues as if nothing had been filmed, on any backend. To film the
    training episodes themselves, give the agent an environment in ``gymnasium.wrappers.RecordVideo``.
    """

    def __init__(
        self,
        folder: str | Path,
        every: int | None = None,
        *,
        every_episodes: int | None = None,
        env: str | gym.Env | Callable[[], gym.Env] | None = None,
        episodes: int = 1,
        max_steps: int = 1500,
        seed: int | None = None,
    ) -> None:
        """Films nothing yet.

        Args:
            folder: of the films; made with the first.
            every: environment steps between two films; None with ``every_episodes``.
            every_episodes: finished training episodes between two films.
            env: as for :func:`rejeu.record_video`; None takes new environments like the agent's own.
            episodes: of each film.
            max_steps: environment steps after which a film ends.
            seed: of the filmed environment, the same for every film; None draws one each time.

        Raises:
            ValueError: unless one of ``every`` and ``every_episodes`` is given.
        """
        if (every is None) == (every_episodes is None):
            raise ValueError(f"give one of every={every!r} (steps) and every_episodes={every_episodes!r}")
        self.every = None if every is None else whole("every", every, least=1)
        self.every_episodes = None if every_episodes is None else whole("every_episodes", every_episodes, least=1)
        self.folder, self.env, self.seed = Path(folder), env, seed
        self.episodes = whole("episodes", episodes, least=1)
        self.max_steps = max_steps
        self.paths: list[Path] = []
        """The films so far."""
        self._last_step: int | None = None
        self._n_episodes = 0

    def __call__(self, agent: TrainedAgent, progress: Progress) -> None:
        """Films if that has fallen due in this step."""
        before = step_before(agent, progress) if self._last_step is None else self._last_step
        self._last_step = progress.step
        episodes_before = self._n_episodes
        self._n_episodes += len(progress.episodes)
        if self.every is not None:
            due = crossed(before, progress.step, self.every)
        else:
            assert self.every_episodes is not None
            due = crossed(episodes_before, self._n_episodes, self.every_episodes)
        if due:
            from rejeu.reporting.video import record_video

            path = self.folder / f"step_{progress.step:0{DIGITS}}.mp4"
            film = partial(record_video, agent, path, self.env, self.episodes, self.max_steps, self.seed)
            if agent.failed_writes.attempt(f"film {path}", film, retry=False):
                self.paths.append(path)

    def state_dict(self) -> dict[str, Any]:
        """Returns what it counts, as plain data for a checkpoint."""
        return {"n_episodes": self._n_episodes, "paths": [str(path) for path in self.paths]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Takes back what :meth:`state_dict` returned."""
        self._n_episodes = int(state["n_episodes"])
        self.paths = [Path(path) for path in state["paths"]]
