"""A wrapper that stacks the last observations of a vector environment."""

from __future__ import annotations

from collections.abc import Mapping

from rejeu.core.types import Observation
from rejeu.sb3.common.vec_env.base_vec_env import VecEnv, VecEnvStepReturn, VecEnvWrapper
from rejeu.sb3.common.vec_env.stacked_observations import StackedObservations


class VecFrameStack(VecEnvWrapper):
    """Replaces observations by :class:`StackedObservations`.

    The ``frame_stack`` option of the agents needs less memory in a replay buffer: it stores each frame once.

    Args:
        venv: a vector environment with Box observations, or a Dict of them.
        n_stack: number of observations.
        channels_order: see :class:`StackedObservations`.
    """

    def __init__(
        self, venv: VecEnv, n_stack: int, channels_order: str | Mapping[str, str | None] | None = None
    ) -> None:
        self.n_stack = n_stack
        self.stacked_obs = StackedObservations(venv.num_envs, n_stack, venv.observation_space, channels_order)
        super().__init__(venv, self.stacked_obs.stacked_observation_space)

    def reset(self) -> Observation:
        return self.stacked_obs.reset(self.venv.reset())

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        stacked, infos = self.stacked_obs.update(obs, dones, infos)
        return stacked, rewards, dones, infos
