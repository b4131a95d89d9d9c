"""What calls the hooks in the course of one ``learn``, and what it tells them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rejeu.hooks.base import BaseCallback, CallbackList
from rejeu.loops.run import Progress

if TYPE_CHECKING:
    from rejeu.agents import Agent, Callback


class Hooks:
    """What calls the hooks of a callback in the course of one ``learn``."""

    def __init__(self, callback: BaseCallback | None) -> None:
        self.callback = callback
        self._first = 0
        self._n_steps: int | None = None

    def begin(self, agent: Agent, n_steps: int | None, arguments: dict[str, Any]) -> None:
        """Calls what comes before the first step; ``n_steps`` will be taken, None if only something else ends the run."""
        if self.callback is None:
            return
        self._first, self._n_steps = agent.num_timesteps, n_steps
        self.callback.init_callback(agent)
        known = {"self": agent, "env": agent.get_env(), "callback": self.callback, "total_timesteps": n_steps}
        self.callback.on_training_start({**known, **arguments}, globals())
        self.callback.on_rollout_start()

    def step(self, agent: Agent, progress: Progress, obs: Any) -> bool:
        """Calls what comes after a turn of the loop; returns whether to go on.

        Args:
            agent: the agent.
            progress: what the turn did.
            obs: the observations to act on next.
        """
        if self.callback is None:
            return True
        assert progress.result is not None
        result = progress.result
        self.callback.update_locals(
            {
                "progress": progress,
                "actions": progress.action,
                "new_obs": obs,
                "rewards": result.reward,
                "dones": result.terminated | result.truncated,
                "infos": infos_of(agent, progress),
            }
        )
        if not self.callback.on_step():
            return False
        is_last = self._n_steps is not None and agent.num_timesteps - self._first >= self._n_steps
        if progress.rollout_ended or is_last:
            self.callback.on_rollout_end()
            if not is_last:
                self.callback.on_rollout_start()
        return True

    def end(self) -> None:
        """Calls what comes after the last step."""
        if self.callback is not None:
            self.callback.on_training_end()


def told_apart(callback: Any) -> tuple[Hooks, list[Callback]]:
    """Returns what was given to ``learn`` as callbacks with hooks and as functions of ``(agent, progress)``."""
    given = [callback] if callable(callback) or isinstance(callback, BaseCallback) else list(callback or ())
    with_hooks = [one for one in given if isinstance(one, BaseCallback)]
    together = CallbackList(with_hooks) if len(with_hooks) > 1 else with_hooks[0] if with_hooks else None
    return Hooks(together), [one for one in given if not isinstance(one, BaseCallback)]


def infos_of(agent: Agent, progress: Progress) -> list[dict[str, Any]]:
    """Returns one info for each environment, with what Stable-Baselines3's vector environments and Monitor put there."""
    result, env = progress.result, agent.env
    assert result is not None
    assert env is not None
    said = result.info if isinstance(result.info, list) else [{} for _ in range(env.n_envs)]
    infos = [
        {**info, "TimeLimit.truncated": bool(result.truncated[i] and not result.terminated[i])}
        for i, info in enumerate(said)
    ]
    for i in np.flatnonzero(result.terminated | result.truncated).tolist():
        if progress.last_obs is not None:
            infos[i].setdefault("terminal_observation", _row(progress.last_obs, i))
        if not np.isnan(success := env.success(result, i)):
            infos[i].setdefault("is_success", bool(success))
    for episode in progress.episodes:
        counted = {"r": episode.episode_return, "l": episode.length, "t": episode.seconds}
        infos[episode.env].setdefault("episode", counted)
    return infos


def _row(batch: Any, i: int) -> Any:
    if isinstance(batch, dict):
        return {key: _row(part, i) for key, part in batch.items()}
    if isinstance(batch, tuple):
        return tuple(_row(part, i) for part in batch)
    return batch[i]
