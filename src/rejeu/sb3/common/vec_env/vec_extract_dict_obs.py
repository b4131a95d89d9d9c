"""A wrapper that keeps one entry of Dict observations."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from rejeu.sb3.common.vec_env.base_vec_env import TERMINAL_OBSERVATION, StepResult, VecEnv, VecEnvWrapper

__all__ = ["VecExtractDictObs"]


class VecExtractDictObs(VecEnvWrapper):
    """Replaces Dict observations by one of their entries.

    Args:
        venv: a vector environment with Dict observations.
        key: key of the entry.
    """

    def __init__(self, venv: VecEnv, key: str) -> None:
        space = venv.observation_space
        if not isinstance(space, spaces.Dict) or key not in space.spaces:
            raise ValueError(f"the observations are {space} and have no {key!r}")
        super().__init__(venv, space[key])
        self.key = key

    def reset(self) -> np.ndarray:
        """Resets the environments and returns that entry of the observations."""
        return self.venv.reset()[self.key]

    def step_wait(self) -> StepResult:
        """Steps the environments and returns that entry of the observations, rewards, dones and infos."""
        obs, rewards, dones, infos = self.venv.step_wait()
        for info in infos:
            if TERMINAL_OBSERVATION in info:
                info[TERMINAL_OBSERVATION] = info[TERMINAL_OBSERVATION][self.key]
        return obs[self.key], rewards, dones, infos
