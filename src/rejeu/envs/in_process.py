"""Environments stepped one after the other in this process."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import jax
import numpy as np
from numpy import ndarray

from rejeu.envs import answers, faults, goals as goals_module, snapshot
from rejeu.envs.base import Step, VectorEnv, describe_spec, success_of
from rejeu.envs.conversions import FLAGS, LARGEST, flag_of, reward_of
from rejeu.envs.goals import GoalFunctions
from rejeu.envs.seeds import Seed, for_each
from rejeu.errors import BadEnvironmentError
from rejeu.spaces import leaves, structure


class InProcess(VectorEnv):
    """Gymnasium environments stepped one after the other in this process.

    What they answer is checked as it comes, for some nanoseconds: :class:`rejeu.errors.BadEnvironmentError` says which
    environment answered what at which step. What an environment itself raises is raised as it is.
    """

    backend = "gymnasium"

    def __init__(self, envs: Sequence[gym.Env], seed: Seed = None, venv: Any = None) -> None:
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
        self.n_steps = 0
        """How often the vector was stepped."""
        self._all = range(self.n_envs)
        self._seed = seed
        self._leaves = leaves(self.observation_space)
        self._stores = [np.zeros((self.n_envs, *leaf.shape), leaf.dtype) for leaf in self._leaves]
        self._put = answers.writer(self.observation_space, self._stores)
        only = self._stores[0] if isinstance(self.observation_space, gym.spaces.Box) else None
        self._hot = (self._put, only, math.prod(self._leaves[0].shape), self.observation_space.dtype)
        """What every step needs, in one place; ``only`` is the store of observations that are one array."""
        self._obs = jax.tree.unflatten(structure(self.observation_space), self._stores)

    def handed_on(self, wrap: Callable[[gym.Env], gym.Env], seed: Seed = None) -> InProcess:
        """Returns the same environments wrapped, as another vector that is to be used in place of this one.

        It takes over the seed of the first reset if that is still to come; ``seed`` is for where there is none.
        """
        seed, self._seed = seed if self._seed is None else self._seed, None
        wrapped = InProcess([wrap(env) for env in self.envs], seed)
        wrapped.seeds = self.seeds
        return wrapped

    def reset(self, seed: Seed = None) -> Any:
        seed = self._seed if seed is None else seed
        self._seed = None
        for i, (env, own_seed) in enumerate(zip(self.envs, for_each(seed, self.n_envs), strict=True)):
            try:
                self._put(i, answers.reset(env, own_seed)[0])
            except BadEnvironmentError as error:
                raise self._bad(i, str(error), error) from error.__cause__
        return self._obs

    def _step_some(self, action: np.ndarray, active: np.ndarray) -> Step:
        return self._step_all(action, np.flatnonzero(active).tolist())

    def _step_all(self, action: np.ndarray, which: Sequence[int] | None = None) -> Step:
        """Steps the environments ``which``, None for all."""
        reward = np.zeros(self.n_envs, np.float32)
        terminated = np.zeros(self.n_envs, bool)
        truncated = np.zeros(self.n_envs, bool)
        info: list[dict[str, Any]] = [{}] * self.n_envs
        envs = self.envs
        put, only, size, dtype = self._hot
        self.n_steps += 1
        for i in self._all if which is None else which:
            answer = envs[i].step(action[i])
            try:
                obs, gain, ended, cut, info[i] = answer
                if only is not None and type(obs) is ndarray and obs.size == size and obs.dtype is dtype:
                    only[i] = obs  # what put does, without the call
                else:
                    put(i, obs)
                if type(gain) is not float or not -LARGEST <= gain <= LARGEST:
                    gain = reward_of(gain)
                reward[i] = gain
                if ended is not False:
                    terminated[i] = ended if type(ended) in FLAGS else flag_of(ended)
                if cut is not False:
                    truncated[i] = cut if type(cut) in FLAGS else flag_of(cut)
                if type(info[i]) is not dict and not isinstance(info[i], dict):
                    raise TypeError("the info is no dict")
            except Exception as error:  # whatever NumPy says of an answer that does not fit
                raise self._bad(i, faults.step_fault(answer, self.observation_space), error) from error
        return Step(self._obs, reward, terminated, truncated, info)

    def reset_done(self, done: np.ndarray) -> Any:
        envs, put = self.envs, self._put
        for i in np.flatnonzero(done).tolist():
            answer = envs[i].reset()
            try:
                obs, info = answer
                if type(answer) is not tuple or not isinstance(info, dict):
                    raise TypeError("no tuple of an observation and a dict")
                put(i, obs)
            except Exception as error:  # whatever NumPy says of an answer that does not fit
                raise self._bad(i, faults.reset_fault(answer, self.observation_space), error) from error
        return self._obs

    def _bad(self, i: int, fault: str | None, error: Exception) -> BadEnvironmentError:
        """Returns what is wrong with environment ``i``'s answer, be it only what NumPy said of it."""
        said = fault or f"{type(error).__name__}: {error}"
        return BadEnvironmentError(faults.blamed(self.env_id, i, self.n_steps, said))

    def success(self, step: Step, env: int) -> float:
        return success_of(step.info[env])

    def identities(self) -> set[int]:
        return {id(self), *(id(env.unwrapped) for env in self.envs)}

    def goals(self) -> GoalFunctions | None:
        return goals_module.goal_functions(self.envs[0])

    def snapshot(self) -> list[Any] | None:
        states = [snapshot.state_of(env) for env in self.envs]
        return None if any(one is None for one in states) else states

    def restore(self, saved: Any, obs: Any) -> list[int]:
        snapshot.check_count(saved, self.n_envs)
        for env, one in zip(self.envs, saved, strict=True):
            snapshot.restore(env, one)
        for store, leaf in zip(self._stores, jax.tree.leaves(obs), strict=True):
            store[...] = leaf
        self._seed = None  # they have been reset, in another process
        return [i for i, env in enumerate(self.envs) if snapshot.is_over(env)]

    def close(self) -> None:
        for env in self.envs:
            env.close()
