"""A wrapper that keeps one entry of Dict observations."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from rejeu.sb3.common.vec_env.base_vec_env import ObservationWrapper, VecEnv


class VecExtractDictObs(ObservationWrapper):
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

    def map_observation(self, obs: dict[str, np.ndarray]) -> np.ndarray:
        """Returns that entry of the observations."""
        return obs[self.key]
