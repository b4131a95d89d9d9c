"""Several environments of one kind, each watched by a ``Monitor``, as Stable-Baselines3's ``make_vec_env`` makes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym

from rejeu.envs.auto_reset import DummyVecEnv
from rejeu.envs.monitor import Monitor
from rejeu.envs.registry import make_env
from rejeu.envs.vec_env import VecEnv
from rejeu.validation import whole


def make_vec_env(
    env_id: str | Callable[..., gym.Env],
    n_envs: int = 1,
    seed: int | None = None,
    start_index: int = 0,
    monitor_dir: str | Path | None = None,
    wrapper_class: Callable[..., gym.Env] | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    vec_env_cls: Callable[..., VecEnv] | None = None,
    vec_env_kwargs: Mapping[str, Any] | None = None,
    monitor_kwargs: Mapping[str, Any] | None = None,
    wrapper_kwargs: Mapping[str, Any] | None = None,
) -> VecEnv:
    """Returns ``n_envs`` environments as one vector environment that resets itself.

    rejeu's own :func:`rejeu.make_vector` is faster where EnvPool has the environment.

    Args:
        env_id: an id, whose environments are made with ``render_mode="rgb_array"`` where they take it; or a function or
            class that makes an environment.
        n_envs: how many.
        seed: environment i is first reset with ``seed + i``; an agent that learns here seeds them anew by its own.
        start_index: number of the first, in the names of the files of ``monitor_dir`` and the seeds of action spaces.
        monitor_dir: where each ``Monitor`` writes ``{number}.monitor.csv``; made if missing. None writes nothing.
        wrapper_class: put around each ``Monitor``.
        env_kwargs: for the environment.
        vec_env_cls: :class:`DummyVecEnv` (None), ``SubprocVecEnv`` or another that takes a list of functions.
        vec_env_kwargs: for that.
        monitor_kwargs: for the ``Monitor``.
        wrapper_kwargs: for the wrapper.

    >>> env = make_vec_env("CartPole-v1", n_envs=4, seed=0)
    >>> env.reset().shape
    (4, 4)
    """
    n_envs = whole("n_envs", n_envs, least=1)
    folder = None if monitor_dir is None else Path(monitor_dir)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    makers = [
        _Maker(
            env_id,
            dict(env_kwargs or {}),
            None if seed is None else seed + rank,
            None if folder is None else folder / str(rank),
            dict(monitor_kwargs or {}),
            wrapper_class,
            dict(wrapper_kwargs or {}),
        )
        for rank in range(start_index, start_index + n_envs)
    ]
    venv = (DummyVecEnv if vec_env_cls is None else vec_env_cls)(makers, **(vec_env_kwargs or {}))
    venv.seed(seed)
    return venv


@dataclass(frozen=True)
class _Maker:
    """Makes one environment; can be sent to another process."""

    env_id: str | Callable[..., gym.Env]
    env_kwargs: dict[str, Any]
    action_seed: int | None
    monitor_path: Path | None
    monitor_kwargs: dict[str, Any]
    wrapper: Callable[..., gym.Env] | None
    wrapper_kwargs: dict[str, Any]

    def __call__(self) -> gym.Env:
        env = self._make()
        if self.action_seed is not None:
            env.action_space.seed(self.action_seed)
        env = Monitor(env, self.monitor_path, **self.monitor_kwargs)
        return env if self.wrapper is None else self.wrapper(env, **self.wrapper_kwargs)

    def _make(self) -> gym.Env:
        if not isinstance(self.env_id, str):
            return self.env_id(**self.env_kwargs)
        if "render_mode" in self.env_kwargs:
            return make_env(self.env_id, **self.env_kwargs)
        try:
            return make_env(self.env_id, render_mode="rgb_array", **self.env_kwargs)
        except TypeError as error:
            if "render_mode" not in str(error):
                raise
            return make_env(self.env_id, **self.env_kwargs)
