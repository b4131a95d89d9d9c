"""Creation of vector environments: :func:`make_vector` chooses and makes the backend.

Each backend has a module of its own: :mod:`rejeu.envs.in_process`, :mod:`rejeu.envs.workers.vector`,
:mod:`rejeu.envs.envpool` and :mod:`rejeu.envs.gymnasium_vector`. Their common interface is :mod:`rejeu.envs.base`.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Literal

import gymnasium as gym

from rejeu.envs import seeds
from rejeu.envs.adapters import adapter_of
from rejeu.envs.base import Step, VectorEnv
from rejeu.envs.envpool import EnvPool, check_envpool_knows, envpool_knows
from rejeu.envs.functional import registry as functional
from rejeu.envs.functional.protocol import FunctionalEnv
from rejeu.envs.functional.vector import JaxVector
from rejeu.envs.gymnasium_vector import GymnasiumVector
from rejeu.envs.in_process import InProcess
from rejeu.envs.registry import maker, register
from rejeu.envs.seeds import Seed
from rejeu.envs.workers.pool import TIMEOUT, check_options
from rejeu.envs.workers.vector import InWorkers

Backend = Literal["auto", "envpool", "gymnasium", "gymnasium-async", "jax"]
BACKENDS: tuple[Backend, ...] = ("auto", "envpool", "gymnasium", "gymnasium-async", "jax")
ENVPOOL_FROM = 4
"""Smallest number of environments for which ``backend="auto"`` prefers EnvPool."""

__all__ = [
    "Backend",
    "EnvPool",
    "GymnasiumVector",
    "InProcess",
    "InWorkers",
    "Step",
    "VectorEnv",
    "make_vec",
    "make_vector",
]


def make_vector(
    env: Any,
    n_envs: int = 1,
    backend: Backend = "auto",
    seed: Seed = None,
    *,
    worker_timeout: float | None = TIMEOUT,
    restart_workers: int = 0,
    **env_kwargs: Any,
) -> VectorEnv:
    """Returns a vector environment of ``n_envs`` environments.

    Args:
        env: an id; a Gymnasium environment (then ``n_envs`` must be 1); a function that makes one; an environment in JAX
            (:class:`rejeu.envs.functional.FunctionalEnv`); or a vector environment of Gymnasium's or Stable-Baselines3's
            kind, whose automatic resets are undone.
        n_envs: how many; ignored for vector environments.
        backend: ``"envpool"`` (C++ threads), ``"gymnasium"`` (in this process), ``"gymnasium-async"`` (one worker process
            each), ``"jax"`` (compiled, for ids that begin with ``jax/``), or ``"auto"`` (see :func:`auto_backend`). The
            attribute ``backend`` of the result tells which.
        seed: seeds the environments at their first reset: a number, from which environment i takes the i-th after it, or a
            sequence of one number for each environment. An agent that trains in them begins with its own seed instead of a
            number, and keeps a sequence. None draws one.
        worker_timeout: seconds that worker processes have for a step or a reset before they count as hung; None: for
            ever. Of no meaning on other backends.
        restart_workers: how many worker processes that crashed or hung are restarted, with a warning, and their
            episode counted as truncated there; after that, and by default, :class:`rejeu.errors.WorkerError` is raised.
            Only for ``backend="gymnasium-async"``.
        env_kwargs: handed to ``gymnasium.make``.

    Raises:
        ValueError: for an unknown id or backend, with the nearest known; for seeds that are not one for each environment.
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
    check_workers(env, backend, worker_timeout, restart_workers)
    if isinstance(env, VectorEnv | gym.vector.VectorEnv) or adapter_of(env) is not None:
        n_envs = env.n_envs if isinstance(env, VectorEnv) else env.num_envs
    seed = seeds.checked(seed, n_envs)
    vector = _made(env, n_envs, backend, seed, worker_timeout, restart_workers, env_kwargs)
    if isinstance(seed, tuple):
        vector.seeds = seed
    return vector


make_vec = make_vector
"""Gymnasium's name of :func:`make_vector`."""


def _made(
    env: Any,
    n_envs: int,
    backend: Backend,
    seed: Seed,
    worker_timeout: float | None,
    restart_workers: int,
    env_kwargs: dict[str, Any],
) -> VectorEnv:
    """Returns what :func:`make_vector` does, for arguments that were checked."""
    if isinstance(env, VectorEnv):
        return env
    if (adapter := adapter_of(env)) is not None:
        return adapter(env, seed)
    if isinstance(env, gym.vector.VectorEnv):
        return GymnasiumVector(env, seed)
    if isinstance(env, FunctionalEnv):
        return JaxVector(env, n_envs, seed)
    if isinstance(env, gym.Env):
        if n_envs != 1:
            raise ValueError(
                f"n_envs={n_envs} needs an id or a function that makes an environment, not one environment"
            )
        return InProcess([env], seed)
    if callable(env):
        if backend == "gymnasium-async":
            return InWorkers(env, n_envs, seed, worker_timeout, restart_workers)
        return InProcess([env() for _ in range(n_envs)], seed)
    if not isinstance(env, str):
        raise TypeError(
            f"env must be an id, a Gymnasium environment, a function that makes one or a vector environment, got "
            f"{type(env).__name__}"
        )
    vector = _of_id(env, n_envs, backend, seed, worker_timeout, restart_workers, env_kwargs)
    vector.made_from = env, env_kwargs
    return vector


def _of_id(
    env: str,
    n_envs: int,
    backend: Backend,
    seed: Seed,
    worker_timeout: float | None,
    restart_workers: int,
    env_kwargs: dict[str, Any],
) -> VectorEnv:
    if backend == "auto":
        backend = auto_backend(env, n_envs, env_kwargs)
    if backend == "envpool":
        if env_kwargs:
            raise ValueError(f"the envpool backend takes no environment arguments, got {env_kwargs}; use 'gymnasium'")
        check_envpool_knows(env)
        return EnvPool(env, n_envs, seed)
    if backend == "jax":
        threshold = functional.REGISTRY[env].reward_threshold if functional.is_functional(env) else None
        return JaxVector(functional.make(env, **env_kwargs), n_envs, seed, env_id=env, reward_threshold=threshold)
    return make_vector(
        maker(env, **env_kwargs),
        n_envs,
        backend,
        seed,
        worker_timeout=worker_timeout,
        restart_workers=restart_workers,
    )


def auto_backend(env_id: str, n_envs: int, env_kwargs: Mapping[str, Any] = MappingProxyType({})) -> Backend:
    """Returns the backend that ``"auto"`` stands for. It does not depend on the speed of the machine.

    ``"jax"`` if it is an environment in JAX; ``"envpool"`` if EnvPool is installed and has the environment, no arguments are
    given, and there are at least four environments or Gymnasium does not have it; else ``"gymnasium"``. Worker processes are
    used only on request.

    >>> auto_backend("Pendulum-v1", 1), auto_backend("Pendulum-v1", 8, {"g": 9.81})
    ('gymnasium', 'gymnasium')
    """
    if functional.is_functional(env_id):
        return "jax"
    if env_kwargs or (n_envs < ENVPOOL_FROM and register(env_id)):
        return "gymnasium"
    return "envpool" if envpool_knows(env_id) else "gymnasium"


def check_workers(env: Any, backend: Backend, worker_timeout: float | None, restart_workers: int) -> None:
    """Raises ``ValueError`` if options of worker processes are out of range, or given where there will be none."""
    check_options(worker_timeout, restart_workers)
    if restart_workers and (backend != "gymnasium-async" or not (isinstance(env, str) or is_maker(env))):
        raise ValueError(
            f"restart_workers={restart_workers} is for worker processes, got backend={backend!r} and an env of type "
            f"{type(env).__name__}; use backend='gymnasium-async' and an id or a function"
        )


def is_maker(env: Any) -> bool:
    """Returns whether this is a function that makes environments, rather than environments."""
    return callable(env) and not isinstance(env, gym.Env | gym.vector.VectorEnv | VectorEnv) and adapter_of(env) is None
