"""Environments stepped one after the other in this process."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import gymnasium as gym
import jax
import numpy as np

from rejeu.envs import goals as goals_module
from rejeu.envs.contract import Step, VectorEnv, describe_spec, success_of
from rejeu.envs.vec_env import VecEnv
from rejeu.replay.hindsight import GoalFunctions
from rejeu.spaces import flat_keys, leaves, plain, structure


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
