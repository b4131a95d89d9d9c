"""Gymnasium vector environments, with the automatic resets that they came with undone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import jax
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

from rejeu.envs import goals as goals_module, workers
from rejeu.envs.contract import SUCCESS_KEYS, Description, Step, VectorEnv, describe_spec, replaced
from rejeu.replay.hindsight import GoalFunctions
from rejeu.spaces import cast, leaves, plain


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
        self._obs = replaced(step.obs, rest, before)
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


def _put(batch: Any, i: int, one: Any) -> None:
    for store, part in zip(jax.tree.leaves(batch), jax.tree.leaves(one), strict=True):
        store[i] = part
