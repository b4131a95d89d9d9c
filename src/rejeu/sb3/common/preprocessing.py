"""Shapes of observations and actions by their spaces, and the preparation of observations for networks."""

from __future__ import annotations

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from rejeu.core.types import Observation


def is_image_space_channels_first(observation_space: spaces.Box) -> bool:
    """Returns whether the first axis of an image is the shortest; warns if the second is."""
    smallest = int(np.argmin(observation_space.shape))
    if smallest == 1:
        warnings.warn(f"the channels of {observation_space} are taken to be last", UserWarning, stacklevel=2)
    return smallest == 0


def is_image_space(
    observation_space: spaces.Space, check_channels: bool = False, normalized_image: bool = False
) -> bool:
    """Returns whether observations are images: three axes, and ``uint8`` from 0 to 255.

    Args:
        observation_space: the space.
        check_channels: also require 1, 3 or 4 channels.
        normalized_image: the images are scaled already, so that type and bounds are not looked at.
    """
    if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 3:
        return False
    is_bytes = observation_space.dtype == np.uint8
    if not normalized_image and not (
        is_bytes and np.all(observation_space.low == 0) and np.all(observation_space.high == 255)
    ):
        return False
    axis = 0 if is_image_space_channels_first(observation_space) else -1
    return not check_channels or observation_space.shape[axis] in (1, 3, 4)


def maybe_transpose(observation: np.ndarray, observation_space: spaces.Space) -> np.ndarray:
    """Returns an image, or a batch of them, with the channels where the space has them, if they are at the other end."""
    shape = observation_space.shape
    if observation.shape[-3:] == shape or observation.ndim < 3 or not is_image_space(observation_space):
        return observation
    moved = (np.moveaxis(observation, source, target) for source, target in ((-1, -3), (-3, -1)))
    return next((candidate for candidate in moved if candidate.shape[-3:] == shape), observation)


def preprocess_obs(obs: Observation, observation_space: spaces.Space, normalize_images: bool = True) -> Observation:
    """Returns a batch of observations as networks take them, ``float32``: images in [0, 1], choices one-hot.

    Raises:
        NotImplementedError: for other spaces.
    """
    if isinstance(observation_space, spaces.Dict):
        inner = observation_space.spaces.items()
        return {key: preprocess_obs(obs[key], space, normalize_images) for key, space in inner}
    values = jnp.asarray(obs if isinstance(obs, jax.Array) else np.asarray(obs))
    if isinstance(observation_space, spaces.Box):
        scale = 255.0 if normalize_images and is_image_space(observation_space) else 1.0
        return values.astype(jnp.float32) / scale
    if isinstance(observation_space, spaces.Discrete):
        return jax.nn.one_hot(values.reshape(-1), int(observation_space.n), dtype=jnp.float32)
    if isinstance(observation_space, spaces.MultiDiscrete):
        columns = values.reshape(values.shape[0], -1)
        parts = [jax.nn.one_hot(columns[:, i], int(n)) for i, n in enumerate(observation_space.nvec.ravel())]
        return jnp.concatenate(parts, axis=-1, dtype=jnp.float32)
    if isinstance(observation_space, spaces.MultiBinary):
        return values.astype(jnp.float32)
    raise NotImplementedError(f"Preprocessing not implemented for {observation_space}")


def get_obs_shape(observation_space: spaces.Space) -> Any:
    """Returns the shape of an observation: ``(1,)`` for Discrete, a dict of shapes for Dict."""
    if isinstance(observation_space, spaces.Dict):
        return {key: get_obs_shape(space) for key, space in observation_space.spaces.items()}
    if isinstance(observation_space, spaces.Discrete):
        return (1,)
    if isinstance(observation_space, spaces.MultiDiscrete):
        return (len(observation_space.nvec),)
    return tuple(observation_space.shape or ())


def get_flattened_obs_dim(observation_space: spaces.Space) -> int:
    """Returns the length of an observation that is flattened, with choices one-hot."""
    return int(spaces.utils.flatdim(observation_space))


def get_action_dim(action_space: spaces.Space) -> int:
    """Returns the number of components of an action."""
    if isinstance(action_space, spaces.MultiBinary) and not isinstance(action_space.n, int | np.integer):
        raise AssertionError(f"Multi-dimensional MultiBinary({action_space.n}) action space is not supported")
    if isinstance(action_space, spaces.Discrete):
        return 1
    return int(np.prod(action_space.shape or (), dtype=int))


def check_for_nested_spaces(obs_space: spaces.Space) -> None:
    """Raises ``NotImplementedError`` for a Dict or Tuple inside a Dict or Tuple. Agents of rejeu take any nesting."""
    if isinstance(obs_space, spaces.Dict | spaces.Tuple):
        parts = obs_space.spaces.values() if isinstance(obs_space, spaces.Dict) else obs_space.spaces
        if any(isinstance(space, spaces.Dict | spaces.Tuple) for space in parts):
            raise NotImplementedError(f"Nested observation spaces are not supported: {obs_space}")
