"""Environments stepped one after the other in this process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import jax
import numpy as np

from rejeu.core.errors import BadEnvironmentError
from rejeu.core.spaces import leaves, rows, structure
from rejeu.core.types import Info, Observation
from rejeu.envs import goals as goals_module, snapshot, validation
from rejeu.envs.base import Seed, Step, VectorEnv, checked_seed, describe_spec, each_seed, success_of
from rejeu.envs.goals import GoalFunctions
from rejeu.envs.validation import convert_step


class InProcess(VectorEnv):
    """Gymnasium environments stepped one after the other in this process.

    Invalid values raise :class:`rejeu.core.errors.BadEnvironmentError`, which names the environment and the step. Exceptions
    that an environment raises itself are not changed.

    Args:
        envs: the environments.
        seed: seed of the first reset.
        venv: the vector environment with automatic resets that contains them, if there is one.
    """

    backend = "gymnasium"

    def __init__(self, envs: Sequence[gym.Env], seed: Seed = None, venv: Any = None) -> None:
        for fault in filter(None, map(validation.environment_fault, envs)):
            raise TypeError(fault)
        if len({id(env) for env in envs}) < len(envs):
            raise ValueError("one environment was given more than once; the function must make a new one each time")
        self.envs = list(envs)
        self.venv = venv
        self.n_envs = len(envs)
        self.observation_space = envs[0].observation_space
        self.action_space = envs[0].action_space
        self.env_id, self.max_episode_steps, self.reward_threshold = describe_spec(envs[0])
        self.owner: Any = None
        """The vector environment of Gymnasium that they were given in, which may close them when it is deleted."""
        self.n_steps = 0
        """Number of steps of the vector."""
        self._seed = seed
        self._leaves = leaves(self.observation_space)
        self._stores = [np.zeros((self.n_envs, *leaf.shape), leaf.dtype) for leaf in self._leaves]
        self._put = validation.make_writer(self.observation_space, self._stores)
        self._obs = jax.tree.unflatten(structure(self.observation_space), self._stores)

    def with_wrapper(self, wrap: Callable[[gym.Env], gym.Env], seed: Seed = None) -> InProcess:
        """Returns a vector of the same environments in a wrapper, which replaces this one.

        Its first reset uses the seed of this vector's first reset if that has not happened yet, else ``seed``.
        """
        seed, self._seed = seed if self._seed is None else self._seed, None
        wrapped = InProcess([wrap(env) for env in self.envs], seed)
        wrapped.seeds, wrapped.owner, wrapped.made_from = self.seeds, self.owner, self.made_from
        return wrapped

    def reset(self, seed: Seed = None) -> Observation:
        seed = self._seed if seed is None else checked_seed(seed, self.n_envs)
        self._seed = None
        for i, own_seed in enumerate(each_seed(seed, self.n_envs)):
            self._reset(i, own_seed)
        return self._obs

    def reset_done(self, done: np.ndarray) -> Observation:
        for i in np.flatnonzero(done).tolist():
            self._reset(i)
        return self._obs

    def _reset(self, i: int, seed: int | None = None) -> None:
        try:
            result = validation.called_reset(self.envs[i], seed)
        except BadEnvironmentError as error:
            raise self._bad(i, str(error), error) from error.__cause__
        try:
            obs, info = result
            if type(result) is not tuple or not isinstance(info, dict):
                raise TypeError("not a tuple of an observation and a dict")
            self._put(i, obs)
        except Exception as error:  # any exception of NumPy for a value of the wrong type or shape
            raise self._bad(i, validation.reset_fault(result, self.observation_space), error) from error

    def _step_some(self, action: np.ndarray, active: np.ndarray) -> Step:
        return self._step_all(action, np.flatnonzero(active).tolist())

    def _step_all(self, action: np.ndarray, indices: Sequence[int] | None = None) -> Step:
        """Steps the environments with these ``indices``, None for all."""
        reward = np.zeros(self.n_envs, np.float32)
        terminated = np.zeros(self.n_envs, bool)
        truncated = np.zeros(self.n_envs, bool)
        info: list[Info] = [{}] * self.n_envs
        self.n_steps += 1
        action = rows(action)
        for i in range(self.n_envs) if indices is None else indices:
            result = self.envs[i].step(action[i])
            try:
                obs, reward[i], terminated[i], truncated[i], info[i] = convert_step(result)
                self._put(i, obs)
            except Exception as error:  # any exception of NumPy for a value of the wrong type or shape
                raise self._bad(i, validation.step_fault(result, self.observation_space), error) from error
        return Step(self._obs, reward, terminated, truncated, info)

    def _bad(self, i: int, fault: str | None, error: Exception) -> BadEnvironmentError:
        """Returns the error for invalid values of environment ``i``; without a description, that of NumPy."""
        description = fault or f"{type(error).__name__}: {error}"
        return BadEnvironmentError(validation.with_location(self.env_id, i, self.n_steps, description))

    def success(self, step: Step, env: int) -> float:
        return success_of(step.info[env])

    def identities(self) -> set[int]:
        return {id(self), *(id(env.unwrapped) for env in self.envs)}

    def goals(self) -> GoalFunctions | None:
        return goals_module.goal_functions(self.envs[0])

    def snapshot(self) -> list[Any] | None:
        states = [snapshot.state_of(env) for env in self.envs]
        return None if any(state is None for state in states) else states

    def restore(self, saved: Any, obs: Observation) -> list[int]:
        snapshot.check_count(saved, self.n_envs)
        for env, state in zip(self.envs, saved, strict=True):
            snapshot.restore(env, state)
        for store, leaf in zip(self._stores, jax.tree.leaves(obs), strict=True):
            store[...] = leaf
        self._seed = None  # they were reset in another process
        return [i for i, env in enumerate(self.envs) if snapshot.is_over(env)]

    def close(self) -> None:
        for env in self.envs:
            env.close()
