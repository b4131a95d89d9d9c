"""Environments stepped one after the other in this process, behind Stable-Baselines3's interface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from rejeu.envs import batching, validation
from rejeu.envs.rendering import check_renders, rgb_frame
from rejeu.errors import BadEnvironmentError
from rejeu.sb3.common.vec_env.base_vec_env import (
    TERMINAL_OBSERVATION,
    TIME_LIMIT_TRUNCATED,
    Indices,
    StepResult,
    VecEnv,
    is_wrapped,
    stacked,
)

__all__ = ["DummyVecEnv"]


class DummyVecEnv(VecEnv):
    """Environments stepped one after the other in this process, each reset within the step that ends its episode.

    Observations are arrays with a leading axis ``num_envs``, with the structure of the observation space. They, rewards
    ``float32 (num_envs,)``, dones ``bool (num_envs,)`` and the list of infos are new objects at every step.

    Agents step the environments of a ``DummyVecEnv`` directly.

    Args:
        env_fns: functions that each return a new environment.

    Raises:
        TypeError: if ``env_fns`` holds anything but functions.
        ValueError: if two functions return the same environment.

    >>> env = DummyVecEnv([lambda: gym.make("Pendulum-v1")] * 2)
    >>> env.reset().shape
    (2, 3)
    """

    def __init__(self, env_fns: Sequence[Callable[[], gym.Env]]) -> None:
        for function in env_fns:
            if isinstance(function, gym.Env) or not callable(function):
                raise TypeError(
                    f"env_fns must hold functions that make environments, got {type(function).__name__}; "
                    "try DummyVecEnv([lambda: gymnasium.make(id)])"
                )
        if not env_fns:
            raise ValueError("env_fns is empty; give one function for each environment")
        self.envs = [function() for function in env_fns]
        if len({id(env.unwrapped) for env in self.envs}) < len(self.envs):
            raise ValueError("two functions of env_fns returned the same environment; each must make a new one")
        super().__init__(len(self.envs), self.envs[0].observation_space, self.envs[0].action_space)
        self.metadata, self.render_mode = self.envs[0].metadata, self.envs[0].render_mode
        self.n_steps = 0
        """Number of steps of the vector."""
        self._actions: Any = None

    def reset(self) -> Any:
        parts = []
        for i, env in enumerate(self.envs):
            parts.append(self._reset_env(i, env, self._seeds[i], self._options[i]))
        self._reset_seeds()
        self._reset_options()
        return stacked(self.observation_space, parts)

    def step_async(self, actions: Any) -> None:
        self._check_count(actions)
        self._actions = actions

    def step_wait(self) -> StepResult:
        self.n_steps += 1
        parts, infos = [], []
        rewards, dones = np.zeros(self.num_envs, np.float32), np.zeros(self.num_envs, bool)
        for i, env in enumerate(self.envs):
            answer = env.step(self._actions[i])
            if (fault := validation.step_fault(answer, env.observation_space)) is not None:
                raise BadEnvironmentError(validation.with_location(validation.id_of(env), i, self.n_steps, fault))
            obs, rewards[i], terminated, truncated, info = validation.convert_step(answer)
            # A copy: an environment may write its next observation into the same array.
            obs = batching.copy_observation(env.observation_space, obs)
            info = {**info, TIME_LIMIT_TRUNCATED: truncated and not terminated}
            dones[i] = terminated or truncated
            if dones[i]:
                info[TERMINAL_OBSERVATION] = obs
                obs = self._reset_env(i, env)
            parts.append(obs)
            infos.append(info)
        return stacked(self.observation_space, parts), rewards, dones, infos

    def _reset_env(self, i: int, env: gym.Env, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Resets one environment; returns a copy of its observation."""
        try:
            obs, self.reset_infos[i] = batching.reset_env(env, seed, options)
        except BadEnvironmentError as error:
            raise BadEnvironmentError(
                validation.with_location(validation.id_of(env), i, self.n_steps, str(error))
            ) from error
        return batching.copy_observation(env.observation_space, obs)

    def close(self) -> None:
        for env in self.envs:
            env.close()

    def get_images(self) -> list[np.ndarray]:
        check_renders(self)
        return [rgb_frame(env) for env in self.envs]

    def has_attr(self, attr_name: str) -> bool:
        return all(env.has_wrapper_attr(attr_name) for env in self.envs)

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        return [env.get_wrapper_attr(attr_name) for env in self._chosen(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Sets an attribute of each environment.

        It is set where it exists, also inside wrappers. (Stable-Baselines3 sets it on the outermost wrapper, where the
        environment itself does not see it.)
        """
        for env in self._chosen(indices):
            env.set_wrapper_attr(attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        return [env.get_wrapper_attr(method_name)(*method_args, **method_kwargs) for env in self._chosen(indices)]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Indices = None) -> list[bool]:
        return [is_wrapped(env, wrapper_class) for env in self._chosen(indices)]

    def _chosen(self, indices: Indices) -> list[gym.Env]:
        return [self.envs[i] for i in self._get_indices(indices)]
