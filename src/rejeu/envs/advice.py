"""What is unwise about observations: nothing fails by it, but learning is slower, or takes them for something else."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces


def advice_on_observations(space: spaces.Space, path: str = "") -> list[str]:
    """Returns what is unwise about an observation space, one sentence each."""
    where = f" under {path!r}" if path else ""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        found = []
        for key, part in parts:
            name = f"{path}.{key}".lstrip(".")
            if isinstance(part, spaces.Dict | spaces.Tuple):
                found.append(
                    f"the observation under {name!r} is nested; rejeu takes it, Stable-Baselines3 takes one level only"
                )
            found += advice_on_observations(part, name)
        return found
    if not isinstance(space, spaces.Box):
        return []
    if len(space.shape) == 3:
        return _advice_on_image(space, where)
    if len(space.shape) > 1:
        return [f"the observation{where} has the shape {space.shape}; arrays of two axes are flattened"]
    if space.dtype != np.float32 and space.dtype != np.uint8:
        return [f"the observation{where} has the dtype {space.dtype}; use float32, which it is turned into"]
    return []


def _advice_on_image(space: spaces.Box, where: str) -> list[str]:
    found = []
    if space.dtype != np.uint8:
        found.append(f"the image{where} has the dtype {space.dtype}; only uint8 images go through convolutions")
    elif np.any(space.low != 0) or np.any(space.high != 255):
        found.append(f"the image{where} has other bounds than 0 and 255; it is divided by 255 in any case")
    if min(sorted(space.shape)[1:]) < 36 and space.dtype == np.uint8:
        found.append(
            f"the image{where} has the shape {space.shape}; below 36x36 small convolutions are used, below 8x8 none"
        )
    return found
