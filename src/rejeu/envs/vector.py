"""Many environments stepped as one, on four backends behind one contract.

The contract hides nothing: after a step the observation is the true successor, also where the episode ended, and ended
environments stay ended until :meth:`VectorEnv.reset_done` is called.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import jax
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

from rejeu.envs import goals as goals_module
from rejeu.envs.registry import make_env, maker, provider, register, unknown_environment
from rejeu.replay.hindsight import GoalFunctions
from rejeu.spaces import cast, flat_keys, leaves, plain, structure

Backend = Literal["auto", "envpool", "gymnasium", "gymnasium-async"]
BACKENDS: tuple[Backend, ...] = ("auto", "envpool", "gymnasium", "gymnasium-async")


class Step(NamedTuple):
    """What one step of all environments returned."""

    obs: Any
    """True successors, a pytree of arrays ``(n_envs, ...)``; valid until the next call."""
    reward: np.ndarray
    """``float32 (n_envs,)``."""
    terminated: np.ndarray
    """Whether the MDP ended, ``bool (n_envs,)``."""
    truncated: np.ndarray
    """Whether a time limit ended the episode, ``bool (n_envs,)``."""
    info: Any
    """The backend's own info; read it with :meth:`VectorEnv.success`."""


class VectorEnv(ABC):
    """``n_envs`` environments of one kind."""

    n_envs: int
    observation_space: gym.Space
    """Of one environment."""
    action_space: gym.Space
    """Of one environment."""
    backend: str
    """Which backend steps them."""
    env_id: str
    """The id they are registered under, or the class name of what was given."""
    max_episode_steps: int | None = None
    """The time limit, where it is known."""
    reward_threshold: float | None = None
    """The return at which the environment counts as solved, where it declares one."""

    @abstractmethod
    def reset(self, seed: int | None = None) -> Any:
        """Starts an episode in every environment and returns the observations ``(n_envs, ...)``."""

    @abstractmethod
    def step(self, action: np.ndarray) -> Step:
        """Steps every environment; ``action`` is in the environment's own range, ``(n_envs, ...)``."""

    @abstractmethod
    def reset_done(self, done: np.ndarray) -> Any:
        """Starts new episodes where ``done``, ``bool (n_envs,)``; returns the observations of all environments."""

    @abstractmethod
    def success(self, step: Step, env: int) -> float:
        """Returns 1.0 or 0.0 for whether environment ``env`` reached its goal in ``step``, NaN if it does not say."""

    @abstractmethod
    def goals(self) -> GoalFunctions | None:
        """Returns the goal functions, or None for environments without goals."""

    @abstractmethod
    def close(self) -> None:
        """Releases the environments."""


def make_vector(
    env: str | gym.Env | Callable[[], gym.Env] | gym.vector.VectorEnv | VectorEnv,
    n_envs: int = 1,
    backend: Backend = "auto",
    seed: int | None = None,
    **env_kwargs: Any,
) -> VectorEnv:
    """Returns ``n_envs`` environments as one.

    Args:
        env: an id; a Gymnasium environment (then ``n_envs`` must be 1); a function that makes one; or a vector
            environment, whose automatic resets are undone.
        n_envs: how many; ignored for vector environments.
        backend: ``"envpool"`` (C++ threads), ``"gymnasium"`` (in this process), ``"gymnasium-async"`` (one worker process
            each), or ``"auto"``: EnvPool for ids that it knows unless ``env_kwargs`` are given, Gymnasium otherwise. The
            choice is in the result's ``backend``.
        seed: seeds the environments, each differently, at their first reset. None draws one.
        env_kwargs: handed to ``gymnasium.make``.

    Raises:
        ValueError: for an unknown id or backend, with the nearest known.
        MissingExtra: if a package is not installed.
        TypeError: if ``env`` is none of the above.

    >>> make_vector("Pendulum-v1", n_envs=4, backend="gymnasium").n_envs
    4
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend={backend!r} must be one of {', '.join(BACKENDS)}")
    if isinstance(n_envs, bool) or not isinstance(n_envs, int) or n_envs < 1:
        raise ValueError(f"n_envs={n_envs!r} must be a whole number of at least 1")
    if isinstance(env, VectorEnv):
        return env
    behind = getattr(env, "vector", None)
    if isinstance(behind, VectorEnv):
        return behind
    if isinstance(env, gym.vector.VectorEnv):
        return GymnasiumVector(env, seed)
    if isinstance(env, gym.Env):
        if n_envs != 1:
            raise ValueError(
                f"n_envs={n_envs} needs an id or a function that makes an environment, not one environment"
            )
        return InProcess([env], seed)
    if hasattr(env, "envs") and isinstance(env.envs, list):
        return InProcess(env.envs, seed)
    if callable(env):
        if backend == "gymnasium-async":
            return GymnasiumVector(AsyncVectorEnv([env] * n_envs, autoreset_mode=AutoresetMode.DISABLED), seed, env)
        return InProcess([env() for _ in range(n_envs)], seed)
    if not isinstance(env, str):
        raise TypeError(
            f"env must be an id, a Gymnasium environment, a function that makes one or a vector environment, got "
            f"{type(env).__name__}"
        )
    if backend == "auto":
        backend = "envpool" if not env_kwargs and envpool_knows(env) else "gymnasium"
    if backend == "envpool":
        if env_kwargs:
            raise ValueError(f"the envpool backend takes no environment arguments, got {env_kwargs}; use 'gymnasium'")
        check_envpool_knows(env)
        return EnvPool(env, n_envs, seed)
    return make_vector(maker(env, **env_kwargs), n_envs, backend, seed)


class InProcess(VectorEnv):
    """Gymnasium environments stepped one after the other in this process."""

    backend = "gymnasium"

    def __init__(self, envs: Sequence[gym.Env], seed: int | None = None) -> None:
        if len({id(env) for env in envs}) < len(envs):
            raise ValueError(
                "the same environment was given more than once; the function must make a new one each time"
            )
        self.envs = list(envs)
        self.n_envs = len(envs)
        self.observation_space = envs[0].observation_space
        self.action_space = envs[0].action_space
        self.env_id, self.max_episode_steps, self.reward_threshold = describe_spec(envs[0])
        self._seed = seed
        self._leaves = leaves(self.observation_space)
        stores = [np.zeros((self.n_envs, *leaf.shape), leaf.dtype) for leaf in self._leaves]
        self._stores = stores
        self._plain = isinstance(self.observation_space, gym.spaces.Box)
        self._keys = flat_keys(structure(self.observation_space))
        self._obs = jax.tree.unflatten(structure(self.observation_space), stores)

    def reset(self, seed: int | None = None) -> Any:
        seed = self._seed if seed is None else seed
        self._seed = None
        for i, env in enumerate(self.envs):
            obs, _ = env.reset(seed=None if seed is None else seed + i)
            self._store(i, obs)
        return self._obs

    def step(self, action: np.ndarray) -> Step:
        reward = np.empty(self.n_envs, np.float32)
        terminated = np.empty(self.n_envs, bool)
        truncated = np.empty(self.n_envs, bool)
        info = []
        for i, env in enumerate(self.envs):
            obs, reward[i], terminated[i], truncated[i], env_info = env.step(action[i])
            self._store(i, obs)
            info.append(env_info)
        return Step(self._obs, reward, terminated, truncated, info)

    def reset_done(self, done: np.ndarray) -> Any:
        for i in np.flatnonzero(done).tolist():
            self._store(i, self.envs[i].reset()[0])
        return self._obs

    def success(self, step: Step, env: int) -> float:
        return success_of(step.info[env])

    def goals(self) -> GoalFunctions | None:
        return goals_module.goal_functions(self.envs[0])

    def close(self) -> None:
        for env in self.envs:
            env.close()

    def _store(self, i: int, obs: Any) -> None:
        if self._plain:
            self._stores[0][i] = obs
            return
        if self._keys is not None:
            for key, store in zip(self._keys, self._stores, strict=True):
                store[i] = obs[key]
            return
        for store, part in zip(self._stores, jax.tree.leaves(plain(self.observation_space, obs)), strict=True):
            store[i] = part


class GymnasiumVector(VectorEnv):
    """A Gymnasium vector environment, with whatever auto-reset it came with undone."""

    def __init__(
        self, env: gym.vector.VectorEnv, seed: int | None = None, make_one: Callable[[], gym.Env] | None = None
    ) -> None:
        mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        unwrapped = env.unwrapped
        if mode == AutoresetMode.NEXT_STEP and not isinstance(unwrapped, AsyncVectorEnv | gym.vector.SyncVectorEnv):
            raise ValueError(
                f"{type(unwrapped).__name__} resets by itself at the next step, which cannot be undone; make it with "
                "autoreset_mode=AutoresetMode.DISABLED or SAME_STEP"
            )
        self.env = env
        self._same_step = mode == AutoresetMode.SAME_STEP
        self._make_one = make_one
        self.n_envs = env.num_envs
        self.observation_space = env.single_observation_space
        self.action_space = env.single_action_space
        self.backend = "gymnasium-async" if isinstance(unwrapped, AsyncVectorEnv) else "gymnasium"
        spec = env.spec
        self.env_id = spec.id if spec is not None else type(unwrapped).__name__
        self.max_episode_steps = spec.max_episode_steps if spec is not None else None
        self.reward_threshold = spec.reward_threshold if spec is not None else None
        self._seed = seed
        self._leaves = leaves(self.observation_space)
        self._after_reset: Any = None

    def reset(self, seed: int | None = None) -> Any:
        seed = self._seed if seed is None else seed
        self._seed = None
        return cast(self.observation_space, self._leaves, self.env.reset(seed=seed)[0])

    def step(self, action: np.ndarray) -> Step:
        obs, reward, terminated, truncated, info = self.env.step(action)
        obs = cast(self.observation_space, self._leaves, obs)
        if self._same_step:
            self._after_reset = obs
            done = np.flatnonzero(terminated | truncated)
            if len(done):
                obs = jax.tree.map(np.copy, obs)
                for i in done.tolist():
                    _put(obs, i, plain(self.observation_space, info["final_obs"][i]))
        return Step(obs, np.asarray(reward, np.float32), terminated, truncated, info)

    def reset_done(self, done: np.ndarray) -> Any:
        if self._same_step:
            return self._after_reset
        return cast(
            self.observation_space, self._leaves, self.env.reset(options={"reset_mask": np.asarray(done, bool)})[0]
        )

    def success(self, step: Step, env: int) -> float:
        info = step.info.get("final_info", step.info) if self._same_step else step.info
        for key in ("is_success", "success"):
            if key in info and info.get(f"_{key}", np.ones(self.n_envs, bool))[env]:
                return float(info[key][env])
        return float("nan")

    def goals(self) -> GoalFunctions | None:
        unwrapped = self.env.unwrapped
        if isinstance(unwrapped, gym.vector.SyncVectorEnv):
            return goals_module.goal_functions(unwrapped.envs[0])
        if self._make_one is None and isinstance(unwrapped, AsyncVectorEnv):
            self._make_one = unwrapped.env_fns[0]
        return None if self._make_one is None else goals_module.goal_functions(self._make_one())

    def close(self) -> None:
        self.env.close()


class EnvPool(VectorEnv):
    """Environments of the EnvPool package, stepped by C++ threads."""

    backend = "envpool"

    def __init__(self, env_id: str, n_envs: int, seed: int | None = None) -> None:
        self.env_id = env_id
        self.n_envs = n_envs
        self._pool = self._make(seed)
        self.observation_space = self._pool.observation_space
        self.action_space = self._pool.action_space
        self.max_episode_steps = int(self._pool.spec.config.max_episode_steps)
        self.reward_threshold = self._pool.spec.reward_threshold
        self._leaves = leaves(self.observation_space)
        self._obs: Any = None

    def _make(self, seed: int | None) -> Any:
        import envpool

        seed = int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed
        seed %= 2**31 - self.n_envs  # environment i gets seed + i, and EnvPool takes int32
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # its spaces are declared with bounds that float32 rounds
            pool = envpool.make_gymnasium(self.env_id, num_envs=self.n_envs, seed=seed)
            pool.observation_space, pool.action_space  # noqa: B018 - made when first asked for, and kept
        return pool

    def reset(self, seed: int | None = None) -> Any:
        if seed is not None:
            self._pool = self._make(seed)
        self._obs = cast(self.observation_space, self._leaves, self._pool.reset()[0])
        return self._obs

    def step(self, action: np.ndarray) -> Step:
        obs, reward, terminated, truncated, info = self._pool.step(action)
        self._obs = cast(self.observation_space, self._leaves, obs)
        return Step(self._obs, np.asarray(reward, np.float32), terminated, truncated, info)

    def reset_done(self, done: np.ndarray) -> Any:
        ended = np.flatnonzero(done).astype(np.int32)
        fresh = cast(self.observation_space, self._leaves, self._pool.reset(ended)[0])
        obs = jax.tree.map(np.copy, self._obs)
        jax.tree.map(lambda whole, part: whole.__setitem__(ended, part), obs, fresh)
        self._obs = obs
        return obs

    def success(self, step: Step, env: int) -> float:
        value = step.info.get("is_success", step.info.get("success"))
        return float("nan") if value is None else float(value[env])

    def goals(self) -> GoalFunctions | None:
        if "desired_goal" not in getattr(self.observation_space, "spaces", ()):
            return None
        if self.env_id == "parking-v0":
            return GoalFunctions(goals_module.parking_reward)
        return goals_module.goal_functions(make_env(self.env_id))

    def close(self) -> None:
        self._pool.close()


def check_envpool_knows(env_id: str) -> None:
    """Raises ``ValueError`` unless EnvPool has the environment, with the backend or the name to use instead."""
    import envpool

    if env_id not in envpool.list_all_envs():
        known = register(env_id)
        raise ValueError(f"EnvPool has no {env_id}; use backend='gymnasium'" if known else unknown_environment(env_id))


def envpool_knows(env_id: str) -> bool:
    """Returns whether EnvPool is installed and has the environment, and the id is not of a package of its own goals."""
    try:
        import envpool
    except ImportError:
        return False
    if env_id not in envpool.list_all_envs():
        return False
    needs_package_for_goals = provider(env_id) is not None and env_id != "parking-v0"
    return not needs_package_for_goals or register(env_id)


def describe_spec(env: gym.Env) -> tuple[str, int | None, float | None]:
    """Returns id, time limit and reward threshold of a Gymnasium environment."""
    if env.spec is None:
        return type(env.unwrapped).__name__, None, None
    return env.spec.id, env.spec.max_episode_steps, env.spec.reward_threshold


def success_of(info: dict[str, Any]) -> float:
    """Returns 1.0 or 0.0 as an info dict says under ``is_success`` or ``success``, NaN if it says neither."""
    value = info.get("is_success", info.get("success"))
    return float("nan") if value is None else float(np.all(value))


def _put(batch: Any, i: int, one: Any) -> None:
    for store, part in zip(jax.tree.leaves(batch), jax.tree.leaves(one), strict=True):
        store[i] = part
