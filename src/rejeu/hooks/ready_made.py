"""Callbacks for what is done every so often: saving, counting episodes, calling another, showing progress."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from rejeu.hooks.base import BaseCallback, EventCallback
from rejeu.io.checkpoint import SUFFIX
from rejeu.validation import whole


class CheckpointCallback(BaseCallback):
    """Saves the agent every so many calls to ``save_path/{name_prefix}_{steps}_steps.safetensors``.

    Args:
        save_freq: calls between two checkpoints: ``n_envs`` times as many environment steps.
        save_path: folder, made if missing.
        name_prefix: of the files' names.
        save_replay_buffer: save that too, as ``{name_prefix}_replay_buffer_{steps}_steps.safetensors``.
        save_vecnormalize: save the statistics of ``VecNormalize`` too, as ``{name_prefix}_vecnormalize_...``.
        verbose: 2 prints each path.
    """

    def __init__(
        self,
        save_freq: int,
        save_path: str | Path,
        name_prefix: str = "rl_model",
        save_replay_buffer: bool = False,
        save_vecnormalize: bool = False,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        self.save_freq = whole("save_freq", save_freq, least=1)
        self.save_path = Path(save_path)
        self.name_prefix = name_prefix
        self.save_replay_buffer, self.save_vecnormalize = save_replay_buffer, save_vecnormalize

    def _on_step(self) -> bool:
        from rejeu.agents.off_policy import OffPolicyAgent  # which imports this module

        if self.n_calls % self.save_freq == 0:
            self._write(self.model.save, "")
            if self.save_replay_buffer and isinstance(self.model, OffPolicyAgent):
                self._write(self.model.save_replay_buffer, "replay_buffer_")
            statistics = self.model.get_vec_normalize_env()
            if self.save_vecnormalize and statistics is not None:
                self._write(statistics.save, "vecnormalize_")
        return True

    def _write(self, save: Callable[[Path], Any], kind: str) -> None:
        """Saves one file, or warns; the next call that is due writes one of another name."""
        path = self._path(kind)
        if self.model.failed_writes.attempt(str(path), lambda: save(path), retry=False):
            self._say(path)

    def _path(self, kind: str) -> Path:
        return self.save_path / f"{self.name_prefix}_{kind}{self.num_timesteps}_steps{SUFFIX}"

    def _say(self, path: Path) -> None:
        if self.verbose >= 2:
            print(f"Saved {path}")


class StopTrainingOnMaxEpisodes(BaseCallback):
    """Stops once ``max_episodes`` times the number of environments have ended, over all environments.

    Args:
        max_episodes: per environment.
        verbose: 1 says so.
    """

    carried: ClassVar[tuple[str, ...]] = (*BaseCallback.carried, "n_episodes")

    def __init__(self, max_episodes: int, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.max_episodes = whole("max_episodes", max_episodes, least=1)
        self.n_episodes = 0

    def _on_step(self) -> bool:
        self.n_episodes += int(np.sum(self.locals["dones"]))
        goes_on = self.n_episodes < self.max_episodes * self.model.n_envs
        if self.verbose >= 1 and not goes_on:
            print(f"Stopping after {self.n_episodes} episodes in {self.num_timesteps} steps")
        return goes_on


class EveryNTimesteps(EventCallback):
    """Calls another callback every so many environment steps, at the first call after them.

    Args:
        n_steps: environment steps, over all environments.
        callback: what is called; a function takes ``(locals, globals)``.
    """

    carried: ClassVar[tuple[str, ...]] = (*EventCallback.carried, "last_time_trigger")

    def __init__(self, n_steps: int, callback: BaseCallback | Callable[..., Any]) -> None:
        super().__init__(callback)
        self.n_steps = whole("n_steps", n_steps, least=1)
        self.last_time_trigger = 0

    def _on_step(self) -> bool:
        if self.num_timesteps - self.last_time_trigger < self.n_steps:
            return True
        self.last_time_trigger = self.num_timesteps
        return self._on_event()


class ProgressBarCallback(BaseCallback):
    """Shows how far training has come, as ``learn(progress_bar=True)`` does."""

    def __init__(self) -> None:
        super().__init__()
        self._bar: Any = None

    def _on_training_start(self) -> None:
        from rejeu.callbacks import ProgressBar  # which imports the agents

        self._bar = ProgressBar(self.locals["total_timesteps"], None)

    def _on_step(self) -> bool:
        self._bar(self.model, self.locals["progress"])
        return True

    def _on_training_end(self) -> None:
        self._bar.close()
