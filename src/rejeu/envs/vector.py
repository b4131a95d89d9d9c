"""Many environments stepped as one: :func:`make_vector` chooses and makes the backend.

Each backend has a module of its own: :mod:`rejeu.envs.in_process`, :mod:`rejeu.envs.gymnasium_vector`,
:mod:`rejeu.envs.envpool` and :mod:`rejeu.envs.self_resetting`. What they have in common is :mod:`rejeu.envs.contract`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import gymnasium as gym

from rejeu.envs import measuring, workers
from rejeu.envs.contract import Step, VectorEnv, describe_spec
from rejeu.envs.envpool import EnvPool, check_envpool_knows, envpool_knows
from rejeu.envs.gymnasium_vector import GymnasiumVector
from rejeu.envs.in_process import InProcess
from rejeu.envs.registry import maker
from rejeu.envs.vec_env import VecEnv

Backend = Literal["auto", "envpool", "gymnasium", "gymnasium-async"]
BACKENDS: tuple[Backend, ...] = ("auto", "envpool", "gymnasium", "gymnasium-async")

__all__ = ["Backend", "EnvPool", "GymnasiumVector", "InProcess", "Step", "VectorEnv", "make_vector"]


def make_vector(
    env: str | gym.Env | Callable[[], gym.Env] | gym.vector.VectorEnv | VecEnv | VectorEnv,
    n_envs: int = 1,
    backend: Backend = "auto",
    seed: int | None = None,
    **env_kwargs: Any,
) -> VectorEnv:
    """Returns ``n_envs`` environments as one.

    Args:
        env: an id; a Gymnasium environment (then ``n_envs`` must be 1); a function that makes one; or a vector
            environment of Gymnasium's or Stable-Baselines3's kind, whose automatic resets are undone.
        n_envs: how many; ignored for vector environments.
        backend: ``"envpool"`` (C++ threads), ``"gymnasium"`` (in this process), ``"gymnasium-async"`` (one worker process
            each), or ``"auto"``: for an id the fastest, as measured when it was first asked for on this machine (see
            :mod:`rejeu.envs.measuring`); for a function, this process. The result's ``backend`` says which it is, its
            ``measured`` what it was chosen by.
        seed: seeds the environments, each differently, at their first reset. None draws one.
        env_kwargs: handed to ``gymnasium.make``.

    Raises:
        ValueError: for an unknown id or backend, with the nearest known.
        MissingExtra: if a package is not installed.
        TypeError: if ``env`` is none of the above, or a function that cannot be sent to a worker process.
        WorkerError: if a worker process cannot be started.

    >>> make_vector("Pendulum-v1", n_envs=4, backend="gymnasium").n_envs
    4
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend={backend!r} must be one of {', '.join(BACKENDS)}")
    if isinstance(n_envs, bool) or not isinstance(n_envs, int) or n_envs < 1:
        raise ValueError(f"n_envs={n_envs!r} must be a whole number of at least 1")
    if isinstance(env, VectorEnv):
        return env
    if isinstance(env, VecEnv):
        from rejeu.envs.self_resetting import without_resets  # which imports this module

        return without_resets(env, seed)
    if isinstance(env, gym.vector.VectorEnv):
        return GymnasiumVector(env, seed)
    if isinstance(env, gym.Env):
        if n_envs != 1:
            raise ValueError(
                f"n_envs={n_envs} needs an id or a function that makes an environment, not one environment"
            )
        return InProcess([env], seed)
    if callable(env):
        if backend == "gymnasium-async":
            one = env()
            return GymnasiumVector(workers.start(env, one, n_envs), seed, env, describe_spec(one))
        return InProcess([env() for _ in range(n_envs)], seed)
    if not isinstance(env, str):
        raise TypeError(
            f"env must be an id, a Gymnasium environment, a function that makes one or a vector environment, got "
            f"{type(env).__name__}"
        )
    if backend == "auto":
        choice = measuring.choose(
            lambda backend, n: make_vector(env, n, backend, 0, **env_kwargs),  # type: ignore[arg-type]
            env,
            n_envs,
            env_kwargs,
            lambda: not env_kwargs and envpool_knows(env),
        )
        vector = make_vector(env, n_envs, choice.backend, seed, **env_kwargs)  # type: ignore[arg-type]
        vector.measured, vector.passed_over = choice.measured, choice.passed_over
        return vector
    if backend == "envpool":
        if env_kwargs:
            raise ValueError(f"the envpool backend takes no environment arguments, got {env_kwargs}; use 'gymnasium'")
        check_envpool_knows(env)
        return EnvPool(env, n_envs, seed)
    return make_vector(maker(env, **env_kwargs), n_envs, backend, seed)
