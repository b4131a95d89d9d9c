"""Environments of the EnvPool package, stepped by threads in C++."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import jax
import numpy as np
from numpy.typing import DTypeLike

from rejeu.core.errors import DivergedError
from rejeu.core.spaces import cast, leaves
from rejeu.core.types import JsonObject, Observation
from rejeu.core.validation import whole
from rejeu.envs import goals as goals_module
from rejeu.envs.action_log import MOST_IMAGE_STEPS, MOST_STEPS, ActionLog, replay
from rejeu.envs.base import SEEDS_END, SUCCESS_KEYS, Seed, Step, VectorEnv, checked_seed, success_of, with_rows
from rejeu.envs.goals import PARKED, GoalFunctions, parking_reward
from rejeu.envs.registry import (
    import_envpool,
    in_envpool,
    make_env,
    newer_version,
    provider,
    register,
    unknown_environment,
)

NO_LIMIT = 2**31 - 1
"""EnvPool's time limit of environments without one."""
RACETRACKS = "racetrack", "racetrack-large", "racetrack-oval"
TRAFFIC = "exit", "intersection", "lane-keeping", "merge", "roundabout", "two-way", "u-turn", *RACETRACKS
DIFFERENT = frozenset(("CarRacing", "FetchSlide", "FetchSlideDense", *TRAFFIC))
"""Names of environments of EnvPool 1.2.5 whose first observations are not those of Gymnasium's environment of this name."""


class EnvPool(VectorEnv):
    """Environments of the EnvPool package, stepped by C++ threads.

    For checkpoints its actions are logged. When the log is full (:attr:`ActionLog.is_full`), the pool is created again with a
    seed derived from the previous one, in every run with checkpoints, resumed or not.
    """

    backend = "envpool"

    def __init__(self, env_id: str, n_envs: int, seed: Seed = None) -> None:
        self.env_id = env_id
        self.n_envs = n_envs
        self._pool = self._make(int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed)
        self.observation_space = _corrected_bounds(self._pool.observation_space)
        self.action_space = _corrected_bounds(self._pool.action_space)
        limit = int(self._pool.spec.config.max_episode_steps)
        self.max_episode_steps = limit if 0 < limit < NO_LIMIT else None
        self.reward_threshold = reward_threshold(env_id, self._pool.spec.reward_threshold)
        self._leaves = leaves(self.observation_space)
        self._log = self._new_log(is_on=False)

    def _make(self, seed: int | Sequence[int]) -> Any:
        self._seed = seed
        # Environment i gets seed + i, an int32 in EnvPool.
        seeds = seed % (2**31 - self.n_envs) if isinstance(seed, int) else list(seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the declared bounds of its spaces are rounded to float32
            pool = import_envpool().make_gymnasium(self.env_id, num_envs=self.n_envs, seed=seeds)
            pool.observation_space, pool.action_space  # noqa: B018 - cached at the first access
        return pool

    def _new_log(self, is_on: bool) -> ActionLog:
        draws_images = any(leaf.kind == "image" for leaf in self._leaves)
        return ActionLog(self.n_envs, self.action_space, MOST_IMAGE_STEPS if draws_images else MOST_STEPS, is_on)

    @property
    def must_reset(self) -> bool:
        return self._log.is_on and (self._log.is_full or not self._log.is_complete)

    def record(self) -> None:
        """Logs the actions from now on. A pool that has been used is created again at the next reset."""
        self._log.is_on = True

    def reset(self, seed: Seed = None) -> Observation:
        seed = next_seed(self._seed) if seed is None and self.must_reset else checked_seed(seed, self.n_envs)
        if seed is not None:
            self._pool, self._log = self._make(seed), self._new_log(self._log.is_on)
        self._log.reset()
        self._obs = cast(self.observation_space, self._leaves, self._pool.reset()[0])
        return self._obs

    def _step_all(self, action: np.ndarray) -> Step:
        obs, reward, terminated, truncated, info = self._pool.step(self._log.step(action))
        self._obs = cast(self.observation_space, self._leaves, obs)
        return Step(self._obs, np.asarray(reward, np.float32), terminated, truncated, info)

    def _step_some(self, action: np.ndarray, active: np.ndarray) -> Step:
        ids = np.flatnonzero(active).astype(np.int32)
        action = self._log.step(np.asarray(action)[ids], ids)
        obs, reward, terminated, truncated, info = self._pool.step(action, ids)  # rows in order of ids
        self._obs = with_rows(self._obs, ids, cast(self.observation_space, self._leaves, obs))

        def spread(values: np.ndarray, dtype: DTypeLike) -> np.ndarray:
            whole = np.zeros(self.n_envs, dtype)
            whole[ids] = values
            return whole

        successes = {key: spread(info[key], info[key].dtype) for key in SUCCESS_KEYS if key in info}
        return Step(self._obs, spread(reward, np.float32), spread(terminated, bool), spread(truncated, bool), successes)

    def reset_done(self, done: np.ndarray) -> Observation:
        ended = np.flatnonzero(done).astype(np.int32)
        self._log.reset(ended)
        fresh = cast(self.observation_space, self._leaves, self._pool.reset(ended)[0])
        self._obs = with_rows(self._obs, ended, fresh)
        return self._obs

    def snapshot(self) -> JsonObject | None:
        if not self._log.is_complete:
            return None
        seed = self._seed if isinstance(self._seed, int) else list(self._seed)
        return {"seed": seed, **self._log.to_plain()}

    def restore(self, saved: object, obs: Observation) -> list[int]:
        if not isinstance(saved, dict) or {*saved} != {"seed", "codes", "flags", "actions"}:
            raise ValueError("the record of actions is not one of EnvPool")
        self._pool.close()
        self._pool, self._log = self._make(_saved_seed(saved["seed"], self.n_envs)), self._new_log(is_on=True)
        for indices, action in replay(self._log, saved, self.env_id):
            active = np.isin(np.arange(self.n_envs), indices) if indices is not None else None
            if action is None:
                self.reset() if active is None else self.reset_done(active)
            elif active is None:
                self._step_all(action)
            else:
                every = np.zeros((self.n_envs, *action.shape[1:]), action.dtype)
                every[active] = action
                self._step_some(every, active)
        pairs = zip(jax.tree.leaves(self._obs), jax.tree.leaves(obs), strict=True)
        if not all(np.array_equal(here, there) for here, there in pairs):
            raise DivergedError(f"{self.env_id} on this EnvPool does not repeat the episodes of the run")
        return []

    def success(self, step: Step, env: int) -> float:
        return success_of({key: value[env] for key, value in step.info.items() if key in SUCCESS_KEYS})

    def goals(self) -> GoalFunctions | None:
        if "desired_goal" not in getattr(self.observation_space, "spaces", ()):
            return None
        if self.env_id == "parking-v0":
            return GoalFunctions(parking_reward, lambda *goals, infos=None: parking_reward(*goals) > PARKED)
        return goals_module.goal_functions(make_env(self.env_id))

    def close(self) -> None:
        self._pool.close()


def next_seed(seed: int | Sequence[int]) -> int | Sequence[int]:
    """Returns the seed of the next pool."""
    if isinstance(seed, int):
        return int(np.random.SeedSequence([seed, 1]).generate_state(1)[0])
    return tuple(int(np.random.SeedSequence([env_seed, 1]).generate_state(1)[0]) % SEEDS_END for env_seed in seed)


def _saved_seed(seed: object, n_envs: int) -> int | Sequence[int]:
    """Returns the seed of a pool from a file.

    Raises:
        ValueError: if it is invalid.
    """
    several = checked_seed(seed, n_envs) if isinstance(seed, list) else None
    return whole("seed", seed, least=0) if several is None else several


def check_envpool_knows(env_id: str) -> None:
    """Checks that EnvPool has an environment.

    Raises:
        MissingExtra: if EnvPool is not installed, or its import fails.
        ValueError: if it does not have the environment, or if that has several players, with what to use instead.

    Warns:
        UserWarning: if it is not the same environment as Gymnasium's.
    """
    if env_id not in import_envpool().list_all_envs():
        missing = f"EnvPool does not have {env_id}; use backend='gymnasium'"
        raise ValueError(missing if register(env_id) else unknown_environment(env_id))
    if (n := import_envpool().make_spec(env_id).config.max_num_players) > 1:
        raise ValueError(f"{env_id} of EnvPool has {n} players, and rejeu trains one; use an environment with one")
    if env_id.rpartition("-v")[0] in DIFFERENT:
        warnings.warn(
            f"{env_id} of EnvPool differs from Gymnasium's, from its first observations on; "
            "an agent of one may fail in the other; use backend='gymnasium' or 'gymnasium-async' for Gymnasium's",
            stacklevel=3,
        )


def envpool_knows(env_id: str) -> bool:
    """Returns whether EnvPool can be used for an id.

    It must be installed, and have the environment. False if its environment differs from Gymnasium's, if Gymnasium has only
    a newer version, or if the goals need a package that is not installed.
    """
    if env_id.rpartition("-v")[0] in DIFFERENT:
        return False
    if not in_envpool(env_id) or (env_id not in gym.registry and newer_version(env_id) is not None):
        return False
    source = provider(env_id)
    needs_package_for_goals = source is not None and source.extra and env_id != "parking-v0"
    return not needs_package_for_goals or register(env_id)


def reward_threshold(env_id: str, declared: float | None) -> float | None:
    """Returns Gymnasium's reward threshold of an environment, or ``declared`` if Gymnasium does not have it."""
    if env_id in gym.registry:
        return gym.registry[env_id].reward_threshold
    return None if provider(env_id) is not None else declared


def _corrected_bounds(space: gym.Space) -> gym.Space:
    """Returns a space with infinite bounds where EnvPool declares the smallest positive and the largest float."""
    if isinstance(space, gym.spaces.Dict):
        return gym.spaces.Dict({key: _corrected_bounds(subspace) for key, subspace in space.spaces.items()})
    if isinstance(space, gym.spaces.Box) and space.dtype.kind == "f":
        limits = np.finfo(space.dtype)
        if (space.low == limits.tiny).all() and (space.high == limits.max).all():
            return gym.spaces.Box(-np.inf, np.inf, space.shape, space.dtype.type)
    return space
