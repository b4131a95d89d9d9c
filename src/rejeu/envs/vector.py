"""Many environments stepped as one, on four backends behind one contract.

The contract hides nothing: after a step the observation is the true successor, also where the episode ended, and ended
environments stay ended until :meth:`VectorEnv.reset_done` is called.
"""

from __future__ import annotations

import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import jax
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

from rejeu.envs import goals as goals_module, measuring, workers
from rejeu.envs.registry import make_env, maker, provider, register, unknown_environment
from rejeu.envs.vec_env import VecEnv
from rejeu.replay.hindsight import GoalFunctions
from rejeu.spaces import cast, flat_keys, leaves, plain, structure

Backend = Literal["auto", "envpool", "gymnasium", "gymnasium-async"]
BACKENDS: tuple[Backend, ...] = ("auto", "envpool", "gymnasium", "gymnasium-async")
SUCCESS_KEYS = ("is_success", "success")
"""Where an info says whether the goal was reached; the first that is there counts."""


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
    returns: np.ndarray | None = None
    """The return of each episode that ended, as a ``Monitor`` beneath wrappers that change rewards counted it, ``(n_envs,)``,
    NaN elsewhere; None where the sum of the rewards is the return."""

    def return_of(self, env: int, total: float) -> float:
        """Returns the return of the episode that ended in environment ``env`` and whose rewards sum up to ``total``."""
        counted = math.nan if self.returns is None else float(self.returns[env])
        return float(total) if math.isnan(counted) else counted


class Description(NamedTuple):
    """What an environment is registered as."""

    env_id: str
    """The id, or the name of its class if it has none."""
    max_episode_steps: int | None
    """The time limit, where it is known."""
    reward_threshold: float | None
    """The return at which it counts as solved, where it declares one."""


class VectorEnv(ABC):
    """``n_envs`` environments of one kind."""

    n_envs: int
    observation_space: gym.Space
    """Of one environment."""
    action_space: gym.Space
    """Of one environment."""
    backend: str
    """Which backend steps them."""
    measured: Mapping[str, float] = MappingProxyType({})
    """Steps per second of each backend, over all environments, by which ``"auto"`` chose this one; empty if it had not to."""
    passed_over: Mapping[str, str] = MappingProxyType({})
    """Why ``"auto"`` could not measure a backend."""
    env_id: str
    """The id they are registered under, or the class name of what was given."""
    max_episode_steps: int | None = None
    """The time limit, where it is known."""
    reward_threshold: float | None = None
    """The return at which the environment counts as solved, where it declares one."""
    venv: VecEnv | None = None
    """The vector environment with automatic resets that these are or came from, if there is one."""
    _obs: Any
    """The observations last returned."""

    @abstractmethod
    def reset(self, seed: int | None = None) -> Any:
        """Starts an episode in every environment and returns the observations ``(n_envs, ...)``."""

    def step(self, action: np.ndarray, active: np.ndarray | None = None) -> Step:
        """Steps every environment, or only the ``active`` ones.

        Those left out keep their observation, get the reward 0 and have not ended. A Gymnasium vector environment can only
        be stepped as a whole, so there they move on unseen; on any backend, reset them before they are stepped again.

        Args:
            action: in the environment's own range, ``(n_envs, ...)``; the rows of those left out are ignored.
            active: ``bool (n_envs,)``; None for all.

        Raises:
            ValueError: if ``active`` is no such array, or leaves out every environment.

        >>> vector = make_vector("Pendulum-v1", 2, "gymnasium", seed=0)
        >>> obs = vector.reset().copy()
        >>> step = vector.step(np.ones((2, 1)), active=np.array([True, False]))
        >>> (step.obs == obs).all(axis=1).tolist(), (step.reward == 0.0).tolist()
        ([False, True], [False, True])
        """
        if active is None:
            return self._step_all(action)
        if not isinstance(active, np.ndarray) or active.dtype != bool or active.shape != (self.n_envs,):
            raise ValueError(f"active={active!r} must be a bool array of shape ({self.n_envs},), or None for all")
        if not active.any():
            raise ValueError("active leaves out every environment, so there is nothing to step")
        return self._step_all(action) if active.all() else self._step_some(action, active)

    @abstractmethod
    def _step_all(self, action: np.ndarray) -> Step:
        """Steps every environment."""

    @abstractmethod
    def _step_some(self, action: np.ndarray, active: np.ndarray) -> Step:
        """Steps those that are ``active``, which are neither none nor all."""

    @abstractmethod
    def reset_done(self, done: np.ndarray) -> Any:
        """Starts new episodes where ``done``, ``bool (n_envs,)``; returns the observations of all environments."""

    @abstractmethod
    def success(self, step: Step, env: int) -> float:
        """Returns 1.0 or 0.0 for whether environment ``env`` reached its goal in ``step``, NaN if it does not say."""

    def judge(self, step: Step, env: int, episode_return: float, threshold: float | None) -> float:
        """Returns 1.0 or 0.0 for whether the episode that ``step`` ended in environment ``env`` succeeded.

        Where the environment does not say so itself, an episode succeeds whose return is at least ``threshold``, or the
        environment's own reward threshold if that is None; NaN where there is neither.
        """
        own = self.success(step, env)
        threshold = self.reward_threshold if threshold is None else threshold
        return own if threshold is None or not math.isnan(own) else float(episode_return >= threshold)

    @abstractmethod
    def goals(self) -> GoalFunctions | None:
        """Returns the goal functions, or None for environments without goals."""

    @abstractmethod
    def close(self) -> None:
        """Releases the environments."""


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


class InProcess(VectorEnv):
    """Gymnasium environments stepped one after the other in this process."""

    backend = "gymnasium"

    def __init__(self, envs: Sequence[gym.Env], seed: int | None = None, venv: VecEnv | None = None) -> None:
        if len({id(env) for env in envs}) < len(envs):
            raise ValueError(
                "the same environment was given more than once; the function must make a new one each time"
            )
        self.envs = list(envs)
        self.venv = venv
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

    def handed_on(self, wrap: Callable[[gym.Env], gym.Env], seed: int | None = None) -> InProcess:
        """Returns the same environments wrapped, as another vector that is to be used in place of this one.

        It takes over the seed of the first reset if that is still to come; ``seed`` is for where there is none.
        """
        seed, self._seed = seed if self._seed is None else self._seed, None
        return InProcess([wrap(env) for env in self.envs], seed)

    def reset(self, seed: int | None = None) -> Any:
        seed = self._seed if seed is None else seed
        self._seed = None
        for i, env in enumerate(self.envs):
            obs, _ = env.reset(seed=None if seed is None else seed + i)
            self._store(i, obs)
        return self._obs

    def _step_all(self, action: np.ndarray) -> Step:
        return self._step_each(range(self.n_envs), action)

    def _step_some(self, action: np.ndarray, active: np.ndarray) -> Step:
        return self._step_each(np.flatnonzero(active).tolist(), action)

    def _step_each(self, which: Iterable[int], action: np.ndarray) -> Step:
        reward = np.zeros(self.n_envs, np.float32)
        terminated = np.zeros(self.n_envs, bool)
        truncated = np.zeros(self.n_envs, bool)
        info: list[dict[str, Any]] = [{}] * self.n_envs
        for i in which:
            obs, reward[i], terminated[i], truncated[i], info[i] = self.envs[i].step(action[i])
            self._store(i, obs)
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
        self,
        env: gym.vector.VectorEnv,
        seed: int | None = None,
        make_one: Callable[[], gym.Env] | None = None,
        description: Description | None = None,
    ) -> None:
        mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        unwrapped = env.unwrapped
        if mode == AutoresetMode.NEXT_STEP and not isinstance(unwrapped, AsyncVectorEnv | gym.vector.SyncVectorEnv):
            raise ValueError(
                f"{type(unwrapped).__name__} resets by itself at the next step, which cannot be undone; make it with "
                "autoreset_mode=AutoresetMode.DISABLED or SAME_STEP"
            )
        if mode == AutoresetMode.NEXT_STEP and isinstance(unwrapped, AsyncVectorEnv) and not unwrapped.shared_memory:
            raise ValueError(
                "an AsyncVectorEnv without shared memory that resets by itself at the next step resets twice when it is "
                "reset by hand; make it with autoreset_mode=AutoresetMode.DISABLED"
            )
        self.env = env
        self._same_step = mode == AutoresetMode.SAME_STEP
        self._make_one = make_one
        self.n_envs = env.num_envs
        self.observation_space = env.single_observation_space
        self.action_space = env.single_action_space
        self.backend = "gymnasium-async" if isinstance(unwrapped, AsyncVectorEnv) else "gymnasium"
        if description is None and env.spec is None and isinstance(unwrapped, gym.vector.SyncVectorEnv):
            description = describe_spec(unwrapped.envs[0])
        self.env_id, self.max_episode_steps, self.reward_threshold = description or describe_spec(env)
        self._seed = seed
        self._leaves = leaves(self.observation_space)
        self._after_reset: Any = None
        self._flags = (np.zeros(self.n_envs, bool),) * 2
        """Which have terminated, and which were truncated, and were not reset since; none where they reset themselves."""
        self._strayed = np.zeros(self.n_envs, bool)
        """Which have moved on unseen and were not reset since."""

    def reset(self, seed: int | None = None) -> Any:
        seed = self._seed if seed is None else seed
        self._seed = None
        self._obs = self._after_reset = self._reset(seed=seed)
        self._flags = (np.zeros(self.n_envs, bool),) * 2
        self._strayed = np.zeros(self.n_envs, bool)
        return self._obs

    def _step_all(self, action: np.ndarray) -> Step:
        try:
            obs, reward, terminated, truncated, info = self.env.step(action)
        except (EOFError, ConnectionError) as error:
            self._blame_worker(error)
            raise
        if workers.FAILURE in info:
            raise workers.failed(info)
        obs = cast(self.observation_space, self._leaves, obs)
        if self._same_step:
            self._after_reset = obs
            done = np.flatnonzero(terminated | truncated)
            if len(done):
                obs = jax.tree.map(np.copy, obs)
                for i in done.tolist():
                    _put(obs, i, plain(self.observation_space, info["final_obs"][i]))
        else:
            self._flags = terminated, truncated
        self._obs = obs
        return Step(obs, np.asarray(reward, np.float32), terminated, truncated, info)

    def _step_some(self, action: np.ndarray, active: np.ndarray) -> Step:
        rest = ~active
        before = jax.tree.map(lambda leaf: leaf[rest], self._obs)
        over = (self._flags[0] | self._flags[1]) & rest
        if over.any():
            self._reset(options={"reset_mask": over})
        action = np.array(action)
        action[rest] = action[np.argmax(active)]  # the rows of those left out may hold anything, yet are stepped
        step = self._step_all(action)
        self._strayed |= rest
        self._obs = _replaced(step.obs, rest, before)
        reward = np.where(active, step.reward, np.float32(0.0))
        return Step(self._obs, reward, step.terminated & active, step.truncated & active, step.info)

    def reset_done(self, done: np.ndarray) -> Any:
        done = np.asarray(done, bool)
        if not self._same_step:
            self._obs = self._reset(options={"reset_mask": done})
        elif not (done & self._strayed).any():
            self._obs = self._after_reset
        elif done.all():
            self._obs = self._after_reset = self.reset()
        elif isinstance(self.env.unwrapped, AsyncVectorEnv | gym.vector.SyncVectorEnv):
            self._obs = self._after_reset = self._reset(options={"reset_mask": done & self._strayed})
        else:
            raise ValueError(
                f"{type(self.env.unwrapped).__name__} resets by itself and was stepped while some environments were left "
                "out, so those cannot begin anew one by one; reset all, or make it with autoreset_mode=DISABLED"
            )
        self._flags = self._flags[0] & ~done, self._flags[1] & ~done
        self._strayed = self._strayed & ~done
        return self._obs

    def _reset(self, **arguments: Any) -> Any:
        try:
            obs, info = self.env.reset(**arguments)
        except (EOFError, ConnectionError) as error:
            self._blame_worker(error)
            raise
        if workers.FAILURE in info:
            raise workers.failed(info)
        return cast(self.observation_space, self._leaves, obs)

    def _blame_worker(self, error: Exception) -> None:
        if isinstance(self.env.unwrapped, AsyncVectorEnv):
            raise workers.ended(self.env.unwrapped) from error

    def success(self, step: Step, env: int) -> float:
        info = step.info.get("final_info", step.info) if self._same_step else step.info
        for key in SUCCESS_KEYS:
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
        self.observation_space = _bounded_rightly(self._pool.observation_space)
        self.action_space = self._pool.action_space
        self.max_episode_steps = int(self._pool.spec.config.max_episode_steps)
        self.reward_threshold = reward_threshold(env_id, self._pool.spec.reward_threshold)
        self._leaves = leaves(self.observation_space)

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

    def _step_all(self, action: np.ndarray) -> Step:
        obs, reward, terminated, truncated, info = self._pool.step(action)
        self._obs = cast(self.observation_space, self._leaves, obs)
        return Step(self._obs, np.asarray(reward, np.float32), terminated, truncated, info)

    def _step_some(self, action: np.ndarray, active: np.ndarray) -> Step:
        ids = np.flatnonzero(active).astype(np.int32)
        obs, reward, terminated, truncated, info = self._pool.step(np.asarray(action)[ids], ids)  # rows in order of ids
        self._obs = _replaced(self._obs, ids, cast(self.observation_space, self._leaves, obs))

        def spread(part: np.ndarray, dtype: Any) -> np.ndarray:
            whole = np.zeros(self.n_envs, dtype)
            whole[ids] = part
            return whole

        said = {key: spread(info[key], info[key].dtype) for key in SUCCESS_KEYS if key in info}
        return Step(self._obs, spread(reward, np.float32), spread(terminated, bool), spread(truncated, bool), said)

    def reset_done(self, done: np.ndarray) -> Any:
        ended = np.flatnonzero(done).astype(np.int32)
        fresh = cast(self.observation_space, self._leaves, self._pool.reset(ended)[0])
        self._obs = _replaced(self._obs, ended, fresh)
        return self._obs

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


def describe_spec(env: gym.Env | gym.vector.VectorEnv) -> Description:
    """Returns id, time limit and reward threshold of a Gymnasium environment or vector environment."""
    if env.spec is None:
        return Description(type(env.unwrapped).__name__, None, None)
    limit = env.spec.max_episode_steps
    if limit is None and env.spec.id.startswith("parking-"):  # which ends its episodes itself, after so many seconds
        config = env.unwrapped.config  # type: ignore[union-attr]
        limit = round(config["duration"] * config["policy_frequency"])
    return Description(env.spec.id, limit, env.spec.reward_threshold)


def reward_threshold(env_id: str, declared: float | None) -> float | None:
    """Returns the return at which Gymnasium counts an environment as solved, ``declared`` for one it does not know."""
    if env_id in gym.registry:
        return gym.registry[env_id].reward_threshold
    return None if provider(env_id) is not None else declared


def success_of(info: dict[str, Any]) -> float:
    """Returns 1.0 or 0.0 as an info dict says under ``is_success`` or ``success``, NaN if it says neither."""
    value = info.get("is_success", info.get("success"))
    return float("nan") if value is None else float(np.all(value))


def _bounded_rightly(space: gym.Space) -> gym.Space:
    """Returns a space in which what EnvPool bounds by the least positive and the greatest float is unbounded."""
    if isinstance(space, gym.spaces.Dict):
        return gym.spaces.Dict({key: _bounded_rightly(part) for key, part in space.spaces.items()})
    if isinstance(space, gym.spaces.Box) and space.dtype.kind == "f":
        limits = np.finfo(space.dtype)
        if (space.low == limits.tiny).all() and (space.high == limits.max).all():
            return gym.spaces.Box(-np.inf, np.inf, space.shape, space.dtype.type)
    return space


def _replaced(batch: Any, rows: np.ndarray, part: Any) -> Any:
    """Returns a copy of a batch in which ``rows``, indices or a mask, are those of ``part``."""
    batch = jax.tree.map(np.copy, batch)
    jax.tree.map(lambda whole, new: whole.__setitem__(rows, new), batch, part)
    return batch


def _put(batch: Any, i: int, one: Any) -> None:
    for store, part in zip(jax.tree.leaves(batch), jax.tree.leaves(one), strict=True):
        store[i] = part
