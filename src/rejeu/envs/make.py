"""Creation of vector environments: :func:`make_vector` chooses and makes the backend.

Each backend has a module of its own: :mod:`rejeu.envs.in_process`, :mod:`rejeu.envs.workers.vector`,
:mod:`rejeu.envs.envpool` and :mod:`rejeu.envs.gymnasium_vector`. Their common interface is :mod:`rejeu.envs.base`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import gymnasium as gym

from rejeu.core import validation
from rejeu.core.types import Arguments, Settings
from rejeu.envs import functional
from rejeu.envs.base import Seed, Step as Step, VectorEnv as VectorEnv, checked_seed
from rejeu.envs.envpool import EnvPool as EnvPool, check_envpool_knows, envpool_knows
from rejeu.envs.functional.protocol import FunctionalEnv
from rejeu.envs.functional.vector import JaxVector
from rejeu.envs.gymnasium_vector import GymnasiumVector as GymnasiumVector
from rejeu.envs.in_process import InProcess as InProcess
from rejeu.envs.registry import maker, register
from rejeu.envs.validation import environment_fault
from rejeu.envs.workers.pool import TIMEOUT, check_options
from rejeu.envs.workers.remote import Actors
from rejeu.envs.workers.vector import InWorkers as InWorkers

KINDS = "an id, a Gymnasium environment, a function that makes one or a vector environment"
"""The values that the functions that make vector environments take."""
Backend = Literal["auto", "envpool", "gymnasium", "gymnasium-async", "jax", "ray"]
BACKENDS: tuple[Backend, ...] = ("auto", "envpool", "gymnasium", "gymnasium-async", "jax", "ray")
WORKERS: tuple[Backend, ...] = ("gymnasium-async", "ray")
"""Backends whose environments are in worker processes."""
ENVPOOL_FROM = 4
"""Smallest number of environments for which ``backend="auto"`` prefers EnvPool."""


Adapter = Callable[[Any, Any], VectorEnv]
"""Converts an object with an attribute ``num_envs``, given a seed."""
_adapters: dict[type, Adapter] = {}


def register_adapter(env_class: type, adapter: Adapter) -> None:
    """Lets :func:`make_vector`, and so the agents, accept vector environments of another package's class."""
    _adapters[env_class] = adapter


def adapter_of(env: Any) -> Adapter | None:
    """Returns the adapter for an object, or None if none is registered for its class."""
    return next((adapter for env_class, adapter in _adapters.items() if isinstance(env, env_class)), None)


class WorkerOptions(NamedTuple):
    """Options of environments in workers; see :func:`make_vector`."""

    worker_timeout: float | None = TIMEOUT
    restart_workers: int = 0
    ray: Mapping[str, Any] | None = None


def make_vector(
    env: Any,
    n_envs: int = 1,
    backend: Backend = "auto",
    seed: Seed = None,
    *,
    worker_timeout: float | None = TIMEOUT,
    restart_workers: int = 0,
    ray: Mapping[str, object] | None = None,
    **env_kwargs: Any,
) -> VectorEnv:
    """Returns a vector environment of ``n_envs`` environments.

    Args:
        env: an id; a Gymnasium environment (then ``n_envs`` must be 1); a function that makes one; an environment in JAX
            (:class:`rejeu.envs.functional.FunctionalEnv`); or a vector environment of Gymnasium's or Stable-Baselines3's
            kind, whose automatic resets are undone.
        n_envs: how many; ignored for vector environments.
        backend: ``"envpool"`` (C++ threads), ``"gymnasium"`` (in this process), ``"gymnasium-async"`` (one worker process
            each), ``"ray"`` (one actor each, on the machines of a Ray cluster), ``"jax"`` (compiled, for ids that begin with
            ``jax/``), or ``"auto"`` (see :func:`auto_backend`). The attribute ``backend`` of the result tells which.
        seed: seeds the environments at their first reset: a number, from which environment i takes the i-th after it, or a
            sequence of one number for each environment. An agent that trains in them begins with its own seed instead of a
            number, and keeps a sequence. None draws one.
        worker_timeout: seconds that workers have for a step or a reset before they count as hung; None: for ever. Of no
            meaning on other backends.
        restart_workers: how many workers that crashed, hung or were lost with their machine are restarted, with a warning,
            and their episode counted as truncated there; after that, and by default, :class:`rejeu.core.errors.WorkerError` is
            raised. Only for ``"gymnasium-async"`` and ``"ray"``.
        ray: for ``"ray"``: ``address`` of the cluster (``"HOST:PORT"`` or ``"auto"``; by default that in the environment
            variable ``RAY_ADDRESS``, else Ray is started on this machine), and what each environment reserves:
            ``num_cpus`` (1, or 0 if Ray is started here), ``num_gpus`` (0), ``memory`` in bytes, ``resources`` by name.
        env_kwargs: handed to ``gymnasium.make``.

    Raises:
        ValueError: for an unknown id or backend, with the nearest known; for seeds that are not one for each environment;
            for options out of range, or of another backend.
        MissingExtra: if a package is not installed.
        TypeError: if ``env`` is none of the above, or a function that cannot be sent to a worker process.
        WorkerError: if a worker process cannot be started.
        ClusterError: if the Ray cluster cannot be reached, or has other versions.

    >>> make_vector("Pendulum-v1", n_envs=4, backend="gymnasium").n_envs
    4
    """
    validation.choice("backend", backend, BACKENDS)
    n_envs = validation.whole("n_envs", n_envs, least=1)
    workers = WorkerOptions(worker_timeout, restart_workers, ray)
    check_workers(env, n_envs, backend, workers)
    if isinstance(env, VectorEnv | gym.vector.VectorEnv) or adapter_of(env) is not None:
        n_envs = env.n_envs if isinstance(env, VectorEnv) else env.num_envs
    seed = checked_seed(seed, n_envs)
    vector = _made(env, n_envs, backend, seed, workers, env_kwargs)
    if isinstance(seed, tuple):
        vector.seeds = seed
    return vector


make_vec = make_vector
"""Gymnasium's name of :func:`make_vector`."""


def _made(
    env: Any, n_envs: int, backend: Backend, seed: Seed, workers: WorkerOptions, env_kwargs: Settings
) -> VectorEnv:
    """Returns the vector environment of :func:`make_vector`, for arguments that were checked."""
    if isinstance(env, VectorEnv):
        return env
    if (adapter := adapter_of(env)) is not None:
        return adapter(env, seed)
    if type(env) is gym.vector.SyncVectorEnv:
        in_process = InProcess(env.envs, seed)
        in_process.owner = env
        return in_process
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
        if backend in WORKERS:
            starter = Actors(workers.ray or {}) if backend == "ray" else None
            return InWorkers(env, n_envs, seed, workers.worker_timeout, workers.restart_workers, starter)
        return InProcess([env() for _ in range(n_envs)], seed)
    if not isinstance(env, str):
        raise TypeError(environment_fault(env, KINDS))
    vector = _of_id(env, n_envs, backend, seed, workers, env_kwargs)
    vector.made_from = env, env_kwargs
    return vector


def _of_id(
    env: str, n_envs: int, backend: Backend, seed: Seed, workers: WorkerOptions, env_kwargs: Settings
) -> VectorEnv:
    backend = auto_backend(env, n_envs, env_kwargs) if backend == "auto" else backend
    if backend == "envpool":
        if env_kwargs:
            raise ValueError(f"the envpool backend takes no environment arguments, got {env_kwargs}; use 'gymnasium'")
        check_envpool_knows(env)
        return EnvPool(env, n_envs, seed)
    if backend == "jax":
        threshold = functional.REGISTRY[env].reward_threshold if functional.is_functional(env) else None
        return JaxVector(functional.make(env, **env_kwargs), n_envs, seed, env_id=env, reward_threshold=threshold)
    return make_vector(maker(env, **env_kwargs), n_envs, backend, seed, **workers._asdict())


def auto_backend(env_id: str, n_envs: int, env_kwargs: Arguments = MappingProxyType({})) -> Backend:
    """Returns the backend that ``"auto"`` stands for. It does not depend on the speed of the machine.

    ``"jax"`` if it is an environment in JAX; ``"envpool"`` if EnvPool is installed and has the same environment, no arguments
    are given, and there are at least four environments or Gymnasium does not have it; else ``"gymnasium"``. Worker processes
    are used only on request.

    >>> auto_backend("Pendulum-v1", 1), auto_backend("Pendulum-v1", 8, {"g": 9.81})
    ('gymnasium', 'gymnasium')
    """
    if functional.is_functional(env_id):
        return "jax"
    if env_kwargs or (n_envs < ENVPOOL_FROM and register(env_id)):
        return "gymnasium"
    return "envpool" if envpool_knows(env_id) else "gymnasium"


def check_workers(env: Any, n_envs: int, backend: Backend, options: WorkerOptions) -> None:
    """Raises ``ValueError`` if options of worker processes are out of range, or given where there will be none."""
    if options == WorkerOptions():
        return
    check_options(options.worker_timeout, options.restart_workers)
    in_workers = backend in WORKERS and (isinstance(env, str) or is_maker(env))
    for name, value in options._asdict().items():
        is_given = name != "worker_timeout" and value is not None and (name != "restart_workers" or value)
        if is_given and not in_workers:
            raise ValueError(
                f"{name}={value!s:.40} is for worker processes, got backend={backend!r} and an env of type "
                f"{type(env).__name__}; use backend='gymnasium-async' or 'ray', and an id or a function"
            )
    if options.ray is not None and backend != "ray":
        raise ValueError(f"ray={dict(options.ray)} is for backend='ray', got backend={backend!r}")


def is_maker(env: Any) -> bool:
    """Returns whether this is a function that makes environments, rather than environments."""
    return callable(env) and not isinstance(env, gym.Env | gym.vector.VectorEnv | VectorEnv) and adapter_of(env) is None
