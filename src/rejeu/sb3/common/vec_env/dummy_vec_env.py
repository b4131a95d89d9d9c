"""Environments stepped one after the other in this process, behind Stable-Baselines3's interface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym

from rejeu.core.errors import BadEnvironmentError
from rejeu.core.types import Action, Observation
from rejeu.envs.validation import environment_fault, id_of, reset_env, with_location
from rejeu.envs.workers.process import as_declared, step_and_reset
from rejeu.sb3.common.vec_env.base_vec_env import SingleEnvs, VecEnvIndices, VecEnvStepReturn, stacked


class DummyVecEnv(SingleEnvs):
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
        for fault in filter(None, map(environment_fault, self.envs)):
            raise TypeError(fault)
        if len({id(env.unwrapped) for env in self.envs}) < len(self.envs):
            raise ValueError("two functions of env_fns returned the same environment; each must make a new one")
        super().__init__(len(self.envs), self.envs[0].observation_space, self.envs[0].action_space)
        self.metadata, self.render_mode = self.envs[0].metadata, self.envs[0].render_mode
        self.n_steps = 0
        """Number of steps of the vector."""
        self._actions: Action = None
        self._encode = [as_declared(env.observation_space) for env in self.envs]

    def reset(self) -> Observation:
        parts = []
        for i, env in enumerate(self.envs):
            obs, self.reset_infos[i] = self._located(i, reset_env, env, self._seeds[i], self._options[i])
            parts.append(self._encode[i](obs))
        self._reset_seeds()
        self._reset_options()
        return stacked(self.observation_space, parts)

    def step_async(self, actions: Action) -> None:
        self._check_count(actions)
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        self.n_steps += 1
        return self._stepped(
            # Copies: an environment may write its next observation into the same array.
            self._located(i, step_and_reset, env, encode, action)
            for i, (env, encode, action) in enumerate(zip(self.envs, self._encode, self._actions, strict=False))
        )

    def _located(self, i: int, function: Callable[..., Any], *arguments: object) -> Any:
        """Calls a function; says of an invalid value that it is of environment ``i``."""
        try:
            return function(*arguments)
        except BadEnvironmentError as error:
            where = id_of(self.envs[i]), i, self.n_steps
            raise BadEnvironmentError(with_location(*where, str(error))) from error

    def close(self) -> None:
        for env in self.envs:
            env.close()

    def _call(self, indices: VecEnvIndices, function: Callable[..., Any], *arguments: object) -> list[Any]:
        return [function(self.envs[i], *arguments) for i in self._get_indices(indices)]
