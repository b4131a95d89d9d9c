"""Gymnasium vector environments without their automatic resets."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import gymnasium as gym
import jax
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from gymnasium.vector.async_vector_env import AsyncState

from rejeu.core.errors import BadEnvironmentError, WorkerError
from rejeu.core.spaces import leaves, plain
from rejeu.core.types import Info, Observation
from rejeu.envs import goals as goals_module, validation
from rejeu.envs.base import (
    Seed,
    Step,
    VectorEnv,
    checked_seed,
    describe_spec,
    each_info,
    each_seed,
    step_whole,
    success_of,
)
from rejeu.envs.goals import GoalFunctions

DISABLED = "make the vector with autoreset_mode=gymnasium.vector.AutoresetMode.DISABLED"


class GymnasiumVector(VectorEnv):
    """A Gymnasium vector environment without its automatic resets."""

    def __init__(self, env: gym.vector.VectorEnv, seed: Seed = None) -> None:
        mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        unwrapped = env.unwrapped
        name = type(unwrapped).__name__
        if mode == AutoresetMode.NEXT_STEP and not isinstance(unwrapped, AsyncVectorEnv | gym.vector.SyncVectorEnv):
            single = "" if env.spec is None else f"use rejeu.make_vector({env.spec.id!r}, n_envs={env.num_envs}), or "
            raise ValueError(
                f"{name} resets by itself at the next step, which cannot be undone; {single}give gymnasium.make_vec "
                "vectorization_mode='sync'; a class of your own can reset by AutoresetMode.SAME_STEP, or not (DISABLED)"
            )
        if mode == AutoresetMode.NEXT_STEP and isinstance(unwrapped, AsyncVectorEnv) and not unwrapped.shared_memory:
            raise ValueError(
                "an AsyncVectorEnv without shared memory that resets by itself at the next step resets twice when it is "
                f"reset by hand; {DISABLED}"
            )
        if mode == AutoresetMode.SAME_STEP:
            check_final_observations(unwrapped)
        self.env = env
        self._same_step = mode == AutoresetMode.SAME_STEP
        self.n_envs = env.num_envs
        self.observation_space = env.single_observation_space
        self.action_space = env.single_action_space
        self.backend = "gymnasium-async" if isinstance(unwrapped, AsyncVectorEnv) else "gymnasium"
        single_env = unwrapped.envs[0] if env.spec is None and isinstance(unwrapped, gym.vector.SyncVectorEnv) else env
        self.env_id, self.max_episode_steps, self.reward_threshold = describe_spec(single_env)
        self._seed = seed
        self._leaves = leaves(self.observation_space)
        self._after_reset: Any = None
        self._reset_info: Any = None
        """The info of the last reset, or of the last step that contained one."""
        self._flags = (np.zeros(self.n_envs, bool),) * 2
        """Flags of terminated and of truncated environments that await a reset. All False with automatic resets."""
        self._desynced = np.zeros(self.n_envs, bool)
        """Environments that were stepped while inactive, and have not been reset since."""
        self.n_steps = 0
        """Number of steps of the vector."""

    def reset(self, seed: Seed = None) -> Observation:
        seed = self._seed if seed is None else checked_seed(seed, self.n_envs)
        self._seed = None
        # Other classes of vector environments may not accept a list.
        seeds = seed if seed is None or isinstance(seed, int) else each_seed(seed, self.n_envs)
        self._obs = self._after_reset = self._reset(seed=seeds)
        self._flags = (np.zeros(self.n_envs, bool),) * 2
        self._desynced = np.zeros(self.n_envs, bool)
        return self._obs

    def _step_all(self, action: np.ndarray) -> Step:
        self.n_steps += 1
        result = self._called(self.env.step, action)
        try:
            obs, reward, terminated, truncated, info = result
            obs = validation.to_batch(self.observation_space, self._leaves, self.n_envs, obs)
            reward = validation.to_vector("rewards", reward, self.n_envs, np.float32)
            terminated = validation.to_vector("terminated", terminated, self.n_envs, bool)
            truncated = validation.to_vector("truncated", truncated, self.n_envs, bool)
        except ValueError:
            raise self._bad(
                None, f"step returned {validation.describe_value(result)}, expected {validation.STEP_VALUES}"
            ) from None
        except BadEnvironmentError as error:
            raise self._bad(None, f"step returned {error}") from error.__cause__
        if self._same_step:
            self._after_reset, self._reset_info = obs, info
            done = np.flatnonzero(terminated | truncated)
            if len(done):
                obs = jax.tree.map(np.copy, obs)
                for i in done.tolist():
                    final = plain(self.observation_space, info["final_obs"][i])
                    for store, final_leaf in zip(jax.tree.leaves(obs), jax.tree.leaves(final), strict=True):
                        store[i] = final_leaf
        else:
            self._flags = terminated, truncated
        self._obs = obs
        return Step(obs, reward, terminated, truncated, info)

    def _step_some(self, action: np.ndarray, active: np.ndarray) -> Step:
        over = (self._flags[0] | self._flags[1]) & ~active

        def step_all(action: np.ndarray) -> Step:
            if over.any():
                self._reset(options={"reset_mask": over})
            return self._step_all(action)

        step = step_whole(step_all, self._obs, action, active)
        self._desynced |= ~active
        self._obs = step.obs
        return step

    def reset_done(self, done: np.ndarray) -> Observation:
        done = np.asarray(done, bool)
        if not self._same_step:
            self._obs = self._reset(options={"reset_mask": done})
        elif not (done & self._desynced).any():
            self._obs = self._after_reset
        elif done.all():
            self._obs = self._after_reset = self.reset()
        elif isinstance(self.env.unwrapped, AsyncVectorEnv | gym.vector.SyncVectorEnv):
            self._obs = self._after_reset = self._reset(options={"reset_mask": done & self._desynced})
        else:
            raise ValueError(
                f"{type(self.env.unwrapped).__name__} resets by itself and was stepped while some environments were "
                "inactive, so single ones cannot be reset; reset all, or make it with autoreset_mode=DISABLED"
            )
        self._flags = self._flags[0] & ~done, self._flags[1] & ~done
        self._desynced = self._desynced & ~done
        return self._obs

    def _reset(self, **arguments: Any) -> Any:
        vector: Any = self.env.unwrapped
        if isinstance(vector, AsyncVectorEnv):
            if vector.closed or None in vector.parent_pipes:
                raise WorkerError(
                    "a worker process of this AsyncVectorEnv ended with an exception; make the vector again and give it to "
                    "set_env, or use rejeu.make_vector(function, n_envs, 'gymnasium-async'), whose workers stay"
                )
            pending = vars(vector)["_state"]
            if pending != AsyncState.DEFAULT:  # an interrupted call has asked for something
                getattr(vector, f"{pending.value}_wait")()
        result = self._called(self.env.reset, **arguments)
        if not isinstance(result, tuple) or len(result) != 2:
            raise self._bad(None, f"reset returned {validation.describe_value(result)}, expected (obs, info)")
        self._reset_info = result[1]
        try:
            return validation.to_batch(self.observation_space, self._leaves, self.n_envs, result[0])
        except BadEnvironmentError as error:
            raise self._bad(None, f"reset returned {error}") from error.__cause__

    def _called(self, function: Callable[..., Any], *positional: object, **arguments: Any) -> Any:
        """Calls a method of the vector. An error in the vector itself is attributed to one of its environments.

        The values that single environments return cannot be checked before the vector uses them. Exceptions that an
        environment raises in this process are not changed.
        """
        try:
            return function(*positional, **arguments)
        except (EOFError, ConnectionError) as error:
            if isinstance(self.env.unwrapped, AsyncVectorEnv):
                raise worker_ended(self.env.unwrapped) from error
            raise
        except Exception as error:  # any exception of the vector for an invalid value
            if not is_raised_by_vector(error):
                raise
            ended = (i for i, pipe in enumerate(getattr(self.env.unwrapped, "parent_pipes", ())) if pipe is None)
            advice = "see rejeu.check_env(env) for what it returns against its spaces"
            raise self._bad(next(ended, None), f"{type(error).__name__}: {error}; {advice}") from error

    def _bad(self, env: int | None, fault: str) -> BadEnvironmentError:
        return BadEnvironmentError(validation.with_location(self.env_id, env, self.n_steps, fault))

    def infos(self, begun: bool = False) -> list[Info]:
        return each_info(self._reset_info if begun else self.info, self.n_envs, begun)

    def call(self, name: str) -> list[Any]:
        return [*self._called(self.env.call, name)]  # type: ignore[attr-defined]

    def success(self, step: Step, env: int) -> float:
        return success_of(each_info(step.info, self.n_envs)[env])

    def goals(self) -> GoalFunctions | None:
        unwrapped = self.env.unwrapped
        if isinstance(unwrapped, gym.vector.SyncVectorEnv):
            return goals_module.goal_functions(unwrapped.envs[0])
        return goals_module.goal_functions(unwrapped.env_fns[0]()) if isinstance(unwrapped, AsyncVectorEnv) else None

    def identities(self) -> set[int]:
        return {id(self), id(self.env.unwrapped)}

    def close(self) -> None:
        self.env.close()


def check_final_observations(env: gym.vector.VectorEnv) -> None:
    """Raises ``ValueError`` if resets in the same step overwrite final observations: one array is used for all of them."""
    for make in getattr(env, "env_fns", ())[:1]:
        single, obs = make(), ()
        with suppress(Exception):  # of what is not valid, such as an action that is forbidden
            obs = single.reset(seed=0)[0]
            obs = single.step(single.action_space.sample())[0]
        copies = jax.tree.map(np.array, obs)
        single.reset()
        single.close()
        if not all(map(np.array_equal, jax.tree.leaves(copies), jax.tree.leaves(obs))):
            raise ValueError(
                f"{type(single.unwrapped).__name__} writes all observations into one array, so that those of a reset "
                f"replace the final ones; return a copy, or {DISABLED}"
            )


def is_raised_by_vector(error: Exception) -> bool:
    """Returns whether Gymnasium's vector classes or NumPy raised an error, not one of the environments."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)][1:]
    machinery = ("gymnasium.vector.", "gymnasium.wrappers.vector.", "numpy", "functools")
    return bool(frames) and all(frame.f_globals.get("__name__", "").startswith(machinery) for frame in frames)


def worker_ended(env: AsyncVectorEnv) -> WorkerError:
    """Terminates all workers, and returns an error that names those that exited unexpectedly."""
    gone = []
    for i, process in enumerate(env.processes):
        process.join(0.2)  # the pipe may close shortly before the process exits
        if process.exitcode is not None:
            gone.append(f"that of environment {i} with exit code {process.exitcode}")
    for process in env.processes:
        process.terminate()
    for process in env.processes:
        process.join()
    env.closed = True  # its close method would wait for answers
    return WorkerError(
        f"a worker process ended by itself: {'; '.join(gone) or 'unknown which'}; what it printed may say why"
    )
