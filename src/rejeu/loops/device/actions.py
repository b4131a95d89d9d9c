"""Actions inside compiled code: from the range of algorithms to that of environments, and random ones."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array

from rejeu.buffers.device import below


def scale(space: gym.Space, action: Array) -> Array:
    """Returns actions in the range of the environment, as :func:`rejeu.spaces.scale_action` does on the host.

    Between bounds that are not symmetric about 0, the last bit may differ, because the host computes in 64 bits.

    >>> scale(spaces.Box(-2.0, 2.0, (1,)), jnp.array([[0.25], [3.0]])).tolist()
    [[0.5], [2.0]]
    """
    if isinstance(space, spaces.Box):
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        action = action.reshape(-1, *space.shape)
        if space.dtype.kind != "f":
            levels = jnp.floor(low[None] + (action + 1.0) * (0.5 * (high - low + 1.0))[None])
            return jnp.clip(levels, low[None], high[None]).astype(jax.dtypes.canonicalize_dtype(space.dtype))
        bounded = np.isfinite(low) & np.isfinite(high)
        middle = np.where(bounded, 0.5 * (low + high), 0.0).astype(np.float32)
        half = np.where(bounded, 0.5 * (high - low), 1.0).astype(np.float32)
        scaled = jnp.clip(middle[None] + action * half[None], space.low[None], space.high[None])
        return scaled.astype(jax.dtypes.canonicalize_dtype(space.dtype))
    if isinstance(space, spaces.Discrete):
        return action.astype(jnp.int32) + int(space.start)
    if isinstance(space, spaces.MultiDiscrete):
        starts = np.broadcast_to(space.start, space.nvec.shape).astype(np.int32)
        return action.reshape(-1, *space.nvec.shape) + starts[None]
    assert isinstance(space, spaces.MultiBinary)
    return action.reshape(-1, *space.shape).astype(jnp.int8)


def random_action(space: gym.Space, n: int, key: Array) -> Array:
    """Returns ``n`` uniformly random actions in the range of algorithms, like :func:`rejeu.spaces.random_action`."""
    if isinstance(space, spaces.Box):
        bits = jax.random.bits(key, (n, int(np.prod(space.shape))), jnp.uint32)
        return (bits >> 8).astype(jnp.float32) * jnp.float32(2.0**-23) - 1.0
    sizes: Any = {
        spaces.Discrete: lambda: np.int32(space.n),  # type: ignore[attr-defined]
        spaces.MultiDiscrete: lambda: space.nvec.ravel().astype(np.int32),  # type: ignore[attr-defined]
        spaces.MultiBinary: lambda: np.full(int(np.prod(space.shape)), 2, np.int32),  # type: ignore[arg-type]
    }[type(space)]()
    bits = jax.random.bits(key, (n, *sizes.shape), jnp.uint32)
    return below(bits, sizes if sizes.ndim == 0 else sizes[None])
