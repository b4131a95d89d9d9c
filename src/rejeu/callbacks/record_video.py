"""Videos of the policy in the course of training."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym

from rejeu.callbacks.base import crossed, step_before
from rejeu.core.types import JsonObject
from rejeu.core.validation import as_path, whole
from rejeu.logs.video import record_video
from rejeu.training.run import Progress

DIGITS = 9
"""Of the step in the name of a video."""


class RecordVideo:
    """Records the deterministic policy during training, every so many environment steps or training episodes.

    The files are ``folder/step_<step>.mp4``, with the step in nine digits, so that names sort by time. Each shows one or
    more episodes in a separate environment, so recording does not change training, and every backend is supported. To
    record the training episodes themselves, wrap the environment in ``gymnasium.wrappers.RecordVideo``.
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
        """Records nothing yet.

        Args:
            folder: of the videos; created with the first.
            every: environment steps between two videos; None with ``every_episodes``.
            every_episodes: finished training episodes between two videos.
            env: as for :func:`rejeu.record_video`; None makes new environments like the agent's own.
            episodes: in each video.
            max_steps: environment steps after which a video ends.
            seed: of the recorded environment, the same for every video; None draws one each time.

        Raises:
            ValueError: unless exactly one of ``every`` and ``every_episodes`` is given.
        """
        if (every is None) == (every_episodes is None):
            raise ValueError(f"give one of every={every!r} (steps) and every_episodes={every_episodes!r}")
        self.every = None if every is None else whole("every", every, least=1)
        self.every_episodes = None if every_episodes is None else whole("every_episodes", every_episodes, least=1)
        self.folder, self.env, self.seed = as_path(folder), env, seed
        self.episodes = whole("episodes", episodes, least=1)
        self.max_steps = max_steps
        self.paths: list[Path] = []
        """The videos so far."""
        self._last_step: int | None = None
        self._n_episodes = 0

    def __call__(self, agent: Any, progress: Progress) -> None:
        """Records a video if one is due."""
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
            path = self.folder / f"step_{progress.step:0{DIGITS}}.mp4"
            record = partial(record_video, agent, path, self.env, self.episodes, self.max_steps, self.seed)
            if agent.failed_writes.attempt(f"video {path}", record):
                self.paths.append(path)
                agent.logger.write_video(progress.step, path)

    def state_dict(self) -> JsonObject:
        """Returns its state for a checkpoint."""
        return {"n_episodes": self._n_episodes, "paths": [str(path) for path in self.paths]}

    def load_state_dict(self, state: JsonObject) -> None:
        """Restores what :meth:`state_dict` returned."""
        self._n_episodes = int(state["n_episodes"])
        self.paths = [Path(path) for path in state["paths"]]
