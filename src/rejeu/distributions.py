"""Probability distributions over actions, as NamedTuples of their parameters."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)


class Normal(NamedTuple):
    """Independent normal distributions; the last axis is one event."""

    mean: Array
    """``(..., action_dim)``."""
    log_std: Array
    """Broadcastable to ``mean``, in nats."""

    def sample(self, key: Array) -> Array:
        """Returns one sample, ``(..., action_dim)``."""
        return self.mean + jnp.exp(self.log_std) * jax.random.normal(key, self.mean.shape, self.mean.dtype)

    def log_prob(self, value: Array) -> Array:
        """Returns the log-density of ``value``, ``(...)``, in nats."""
        standardised = (value - self.mean) * jnp.exp(-self.log_std)
        return jnp.sum(-0.5 * jnp.square(standardised) - self.log_std - LOG_SQRT_2PI, axis=-1)

    def entropy(self) -> Array:
        """Returns the differential entropy, ``(...)``, in nats."""
        return jnp.sum(jnp.broadcast_to(self.log_std + 0.5 + LOG_SQRT_2PI, self.mean.shape), axis=-1)

    def mode(self) -> Array:
        """Returns the most likely value, ``(..., action_dim)``."""
        return self.mean


class TanhNormal(NamedTuple):
    """A normal squashed into (-1, 1) by tanh (Haarnoja et al. 2018, arXiv 1801.01290, appendix C).

    The log-density is taken at the value before squashing: ``log N(u) - sum log(1 - tanh(u)^2)``, the last term
    written ``2 (log 2 - u - softplus(-2 u))``, which stays finite and exact where the tanh saturates.
    """

    mean: Array
    """Of the normal before squashing, ``(..., action_dim)``."""
    log_std: Array
    """Of the normal before squashing, broadcastable to ``mean``, in nats."""

    def sample_and_log_prob(self, key: Array) -> tuple[Array, Array]:
        """Returns a sample in (-1, 1), ``(..., action_dim)``, and its log-density, ``(...)``."""
        normal = Normal(self.mean, self.log_std)
        unsquashed = normal.sample(key)
        return jnp.tanh(unsquashed), normal.log_prob(unsquashed) - jnp.sum(log_tanh_slope(unsquashed), axis=-1)

    def sample(self, key: Array) -> Array:
        """Returns one sample in (-1, 1), ``(..., action_dim)``."""
        return jnp.tanh(Normal(self.mean, self.log_std).sample(key))

    def mode(self) -> Array:
        """Returns the squashed mean, ``(..., action_dim)``."""
        return jnp.tanh(self.mean)


def log_tanh_slope(unsquashed: Array) -> Array:
    """Returns ``log(1 - tanh(u)^2)`` elementwise, without cancellation for large ``|u|``."""
    return 2.0 * (math.log(2.0) - unsquashed - jax.nn.softplus(-2.0 * unsquashed))
