"""A wrapper that moves the channels of images to the front."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from rejeu.core.types import Observation
from rejeu.sb3.common.vec_env.base_vec_env import ObservationWrapper, VecEnv, by_key, is_image


class VecTransposeImage(ObservationWrapper):
    """Moves the channels of images to the front: ``(height, width, channels)`` becomes ``(channels, height, width)``.

    rejeu's networks accept either order; this is for scripts that use the observations themselves.

    Args:
        venv: a vector environment with image observations, or a Dict that contains images.
        skip: leave the observations unchanged.
    """

    def __init__(self, venv: VecEnv, skip: bool = False) -> None:
        self.skip = skip
        space = venv.observation_space
        parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
        self._keys = [] if skip else [key for key, leaf in parts.items() if is_image(leaf)]
        if not skip and not self._keys:
            raise ValueError(f"VecTransposeImage needs uint8 images with three axes, got {space}")
        transposed = {key: self.transpose_space(leaf) if key in self._keys else leaf for key, leaf in parts.items()}
        super().__init__(venv, spaces.Dict(transposed) if isinstance(space, spaces.Dict) else transposed[""])

    @staticmethod
    def transpose_space(observation_space: spaces.Space, key: str = "") -> spaces.Box:
        """Returns the space of the transposed images; ``key`` is accepted and ignored."""
        assert isinstance(observation_space, spaces.Box)
        low, high = (np.moveaxis(bound, -1, 0) for bound in (observation_space.low, observation_space.high))
        return spaces.Box(low, high, dtype=observation_space.dtype.type)

    @staticmethod
    def transpose_image(image: np.ndarray) -> np.ndarray:
        """Returns an image, or a batch of images, with the channels first."""
        return np.moveaxis(image, -1, -3)

    def transpose_observations(self, observations: Observation) -> Observation:
        """Returns observations with their images transposed."""
        parts = by_key(observations)
        transposed = {key: self.transpose_image(image) if key in self._keys else image for key, image in parts.items()}
        return transposed.get("", transposed)

    def map_observation(self, obs: Observation) -> Observation:
        """Returns observations with their images transposed."""
        return self.transpose_observations(obs)
