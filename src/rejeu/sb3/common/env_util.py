"""Functions that make and inspect environments."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import gymnasium as gym

from rejeu.core.types import Arguments
from rejeu.core.validation import whole
from rejeu.envs.registry import make_env
from rejeu.sb3.common.atari_wrappers import AtariWrapper
from rejeu.sb3.common.monitor import Monitor
from rejeu.sb3.common.vec_env.base_vec_env import VecEnv, is_wrapped, unwrap_wrapper
from rejeu.sb3.common.vec_env.dummy_vec_env import DummyVecEnv
from rejeu.sb3.modules import passes_on


def make_vec_env(
    env_id: str | Callable[..., gym.Env],
    n_envs: int = 1,
    seed: int | None = None,
    start_index: int = 0,
    monitor_dir: str | Path | None = None,
    wrapper_class: Callable[..., gym.Env] | None = None,
    env_kwargs: Arguments | None = None,
    vec_env_cls: Callable[..., VecEnv] | None = None,
    vec_env_kwargs: Arguments | None = None,
    monitor_kwargs: Arguments | None = None,
    wrapper_kwargs: Arguments | None = None,
) -> VecEnv:
    """Returns a vector environment of ``n_envs`` environments, each wrapped in a ``Monitor``.

    With EnvPool installed, :func:`rejeu.make_vector` is faster for environments that EnvPool has.

    Args:
        env_id: an id, whose environments are made with ``render_mode="rgb_array"`` where they accept it; or a function or
            class that returns an environment.
        n_envs: number of environments.
        seed: environment i is first reset with ``seed + i``. An agent that trains in them uses its own seed instead.
        start_index: number of the first environment, used for the names of the files in ``monitor_dir`` and the seeds of
            the action spaces.
        monitor_dir: folder in which each ``Monitor`` writes ``{number}.monitor.csv``; created if missing. None writes
            no files.
        wrapper_class: wrapper of each environment, outside of the ``Monitor``.
        env_kwargs: arguments of the environment.
        vec_env_cls: :class:`DummyVecEnv` (None), ``SubprocVecEnv`` or another class that takes a list of functions.
        vec_env_kwargs: arguments of that class.
        monitor_kwargs: arguments of the ``Monitor``.
        wrapper_kwargs: arguments of the wrapper.

    >>> env = make_vec_env("CartPole-v1", n_envs=4, seed=0)
    >>> env.reset().shape
    (4, 4)
    """
    n_envs = whole("n_envs", n_envs, least=1)
    folder = None if monitor_dir is None else Path(monitor_dir)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)

    def make(rank: int) -> gym.Env:
        env = made(env_id, env_kwargs or {})
        if seed is not None:
            env.action_space.seed(seed + rank)
        env = Monitor(env, None if folder is None else folder / str(rank), **(monitor_kwargs or {}))
        return env if wrapper_class is None else wrapper_class(env, **(wrapper_kwargs or {}))

    makers = [partial(make, rank) for rank in range(start_index, start_index + n_envs)]
    venv = (DummyVecEnv if vec_env_cls is None else vec_env_cls)(makers, **(vec_env_kwargs or {}))
    venv.seed(seed)
    return venv


def make_atari_env(
    env_id: str | Callable[..., gym.Env],
    n_envs: int = 1,
    seed: int | None = None,
    start_index: int = 0,
    monitor_dir: str | Path | None = None,
    wrapper_kwargs: Arguments | None = None,
    env_kwargs: Arguments | None = None,
    vec_env_cls: Callable[..., VecEnv] | None = None,
    vec_env_kwargs: Arguments | None = None,
    monitor_kwargs: Arguments | None = None,
) -> VecEnv:
    """Returns a vector environment of Atari games in ``AtariWrapper``s; see :func:`make_vec_env`."""
    unsupported = (vec_env_cls, vec_env_kwargs, monitor_kwargs, wrapper_kwargs)
    return make_vec_env(env_id, n_envs, seed, start_index, monitor_dir, AtariWrapper, env_kwargs, *unsupported)


def made(env_id: str | Callable[..., gym.Env], kwargs: Arguments) -> gym.Env:
    """Returns an environment; one of an id with ``render_mode="rgb_array"`` where it accepts that."""
    if not isinstance(env_id, str):
        return env_id(**kwargs)
    try:
        return make_env(env_id, **{"render_mode": "rgb_array", **kwargs})
    except TypeError as error:
        if "render_mode" in kwargs or "render_mode" not in str(error):
            raise
        return make_env(env_id, **kwargs)


passes_on(__name__)
