"""Probability distributions over actions, as NamedTuples of their parameters."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rejeu.core.types import PyTree

LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)
FORBIDDEN = -1e9
"""Logit of an action that a mask forbids: its probability is exactly 0 in float32, and every gradient stays finite."""
EDGE = 1.0 - 1e-6
"""Largest magnitude at which a squashed action is unsquashed: beyond it, float32 has no slope."""


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
        standardized = (value - self.mean) * jnp.exp(-self.log_std)
        return jnp.sum(-0.5 * jnp.square(standardized) - self.log_std - LOG_SQRT_2PI, axis=-1)

    def entropy(self) -> Array:
        """Returns the differential entropy, ``(...)``, in nats."""
        return jnp.sum(jnp.broadcast_to(self.log_std + 0.5 + LOG_SQRT_2PI, self.mean.shape), axis=-1)

    def mode(self) -> Array:
        """Returns the most likely value, ``(..., action_dim)``."""
        return self.mean

    def kl_divergence(self, q: Normal) -> Array:
        """Returns the KL divergence of ``q`` from this distribution, ``(...)``, in nats."""
        shift = jnp.square((self.mean - q.mean) * jnp.exp(-q.log_std))
        log_ratio = q.log_std - self.log_std
        return jnp.sum(log_ratio + 0.5 * (jnp.exp(-2.0 * log_ratio) + shift - 1.0), axis=-1)


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

    def log_prob(self, value: Array) -> Array:
        """Returns the log-density of ``value`` in [-1, 1], ``(...)``, in nats; values at the edge count as near it."""
        unsquashed = jnp.arctanh(jnp.clip(value, -EDGE, EDGE))
        density = Normal(self.mean, self.log_std).log_prob(unsquashed)
        return density - jnp.sum(log_tanh_slope(unsquashed), axis=-1)

    def mode(self) -> Array:
        """Returns the squashed mean, ``(..., action_dim)``."""
        return jnp.tanh(self.mean)

    def kl_divergence(self, q: TanhNormal) -> Array:
        """Returns the KL divergence of ``q`` from this distribution, ``(...)``, in nats: that before squashing."""
        return Normal(self.mean, self.log_std).kl_divergence(Normal(q.mean, q.log_std))


class Categorical(NamedTuple):
    """One choice among several; the last axis of the logits is the choices."""

    logits: Array
    """Unnormalized log-probabilities, ``(..., n)``; :data:`FORBIDDEN` where a choice is not allowed."""

    def sample(self, key: Array) -> Array:
        """Returns one choice, ``int32 (...)``, by the Gumbel trick."""
        noise = jax.random.gumbel(key, self.logits.shape, self.logits.dtype)
        return jnp.argmax(self.logits + noise, axis=-1).astype(jnp.int32)

    def log_prob(self, value: Array) -> Array:
        """Returns the log-probability of the choices ``value``, ``int (...)``, in nats."""
        log_probabilities = jax.nn.log_softmax(self.logits)
        return jnp.take_along_axis(log_probabilities, value[..., None].astype(jnp.int32), axis=-1)[..., 0]

    def entropy(self) -> Array:
        """Returns the entropy, ``(...)``, in nats."""
        log_probabilities = jax.nn.log_softmax(self.logits)
        return -jnp.sum(jnp.exp(log_probabilities) * log_probabilities, axis=-1)

    def mode(self) -> Array:
        """Returns the most likely choice, ``int32 (...)``, the first of equals."""
        return jnp.argmax(self.logits, axis=-1).astype(jnp.int32)

    def kl_divergence(self, q: Categorical) -> Array:
        """Returns the KL divergence of ``q`` from this distribution, ``(...)``, in nats."""
        log_p, log_q = jax.nn.log_softmax(self.logits), jax.nn.log_softmax(q.logits)
        return jnp.sum(jnp.exp(log_p) * (log_p - log_q), axis=-1)


class MultiCategorical(NamedTuple):
    """Several independent choices, each among its own number of possibilities; the last axis of a value is one event."""

    parts: tuple[Categorical, ...]
    """One for each choice, all of the same leading shape."""

    def sample(self, key: Array) -> Array:
        """Returns one sample, ``int32 (..., n_choices)``."""
        keys = jax.random.split(key, len(self.parts))
        return jnp.stack([choice.sample(keys[i]) for i, choice in enumerate(self.parts)], axis=-1)

    def log_prob(self, value: Array) -> Array:
        """Returns the log-probability of ``value``, ``int (..., n_choices)``, summed over the choices, in nats."""
        return sum_of([choice.log_prob(value[..., i]) for i, choice in enumerate(self.parts)])

    def entropy(self) -> Array:
        """Returns the entropy, ``(...)``, in nats."""
        return sum_of([choice.entropy() for choice in self.parts])

    def mode(self) -> Array:
        """Returns the most likely value, ``int32 (..., n_choices)``."""
        return jnp.stack([choice.mode() for choice in self.parts], axis=-1)

    def kl_divergence(self, q: MultiCategorical) -> Array:
        """Returns the KL divergence of ``q`` from this distribution, ``(...)``, in nats."""
        return sum_of([a.kl_divergence(b) for a, b in zip(self.parts, q.parts, strict=True)])


class Bernoulli(NamedTuple):
    """Independent bits; the last axis is one event."""

    logits: Array
    """Log-odds of a one, ``(..., n)``."""

    def sample(self, key: Array) -> Array:
        """Returns one sample of zeros and ones, ``int32 (..., n)``."""
        uniform = jax.random.uniform(key, self.logits.shape, self.logits.dtype)
        return (uniform < jax.nn.sigmoid(self.logits)).astype(jnp.int32)

    def log_prob(self, value: Array) -> Array:
        """Returns the log-probability of the bits ``value``, ``(..., n)``, in nats."""
        signed = jnp.where(value > 0, self.logits, -self.logits)
        return jnp.sum(jax.nn.log_sigmoid(signed), axis=-1)

    def entropy(self) -> Array:
        """Returns the entropy, ``(...)``, in nats."""
        log_one, log_zero = jax.nn.log_sigmoid(self.logits), jax.nn.log_sigmoid(-self.logits)
        return -jnp.sum(jnp.exp(log_one) * log_one + jnp.exp(log_zero) * log_zero, axis=-1)

    def mode(self) -> Array:
        """Returns the most likely bits, ``int32 (..., n)``."""
        return (self.logits > 0).astype(jnp.int32)

    def kl_divergence(self, q: Bernoulli) -> Array:
        """Returns the KL divergence of ``q`` from this distribution, ``(...)``, in nats."""
        log_one = jax.nn.log_sigmoid(self.logits) - jax.nn.log_sigmoid(q.logits)
        log_zero = jax.nn.log_sigmoid(-self.logits) - jax.nn.log_sigmoid(-q.logits)
        share = jax.nn.sigmoid(self.logits)
        return jnp.sum(share * log_one + (1.0 - share) * log_zero, axis=-1)


class Joint(NamedTuple):
    """Independent parts of one action; a value is the values of the parts one after the other, ``float32 (..., width)``."""

    parts: tuple[PyTree, ...]
    """Distributions of the same leading shape."""

    def sample(self, key: Array) -> Array:
        """Returns one sample, ``float32 (..., width)``."""
        keys = jax.random.split(key, len(self.parts))
        return self.joined([factor.sample(keys[i]) for i, factor in enumerate(self.parts)])

    def log_prob(self, value: Array) -> Array:
        """Returns the log-probability of ``value``, ``(...)``, the sum over the parts, in nats."""
        ends = np.cumsum([width(factor) for factor in self.parts])[:-1].tolist()
        pairs = zip(self.parts, jnp.split(value, ends, axis=-1), strict=True)
        return sum_of([factor.log_prob(x[..., 0] if isinstance(factor, Categorical) else x) for factor, x in pairs])

    def entropy(self) -> Array:
        """Returns the entropy, ``(...)``, the sum over the parts, in nats."""
        return sum_of([factor.entropy() for factor in self.parts])

    def mode(self) -> Array:
        """Returns the most likely value, ``float32 (..., width)``."""
        return self.joined([factor.mode() for factor in self.parts])

    def kl_divergence(self, q: Joint) -> Array:
        """Returns the KL divergence of ``q`` from this distribution, ``(...)``, in nats."""
        return sum_of([a.kl_divergence(b) for a, b in zip(self.parts, q.parts, strict=True)])

    def joined(self, values: list[Array]) -> Array:
        """Returns values of the parts as one, ``float32 (..., width)``."""
        pairs = zip(self.parts, values, strict=True)
        columns = [x[..., None] if isinstance(factor, Categorical) else x for factor, x in pairs]
        return jnp.concatenate([column.astype(jnp.float32) for column in columns], axis=-1)


def width(distribution: PyTree) -> int:
    """Returns the numbers of a value of a distribution."""
    if isinstance(distribution, Joint):
        return sum(map(width, distribution.parts))
    if isinstance(distribution, Categorical):
        return 1
    if isinstance(distribution, MultiCategorical):
        return len(distribution.parts)
    return int(distribution[0].shape[-1])


def is_squashed(distribution: object) -> bool:
    """Returns whether a distribution has no entropy in closed form, because it or a part of it is a :class:`TanhNormal`."""
    if isinstance(distribution, Joint):
        return any(map(is_squashed, distribution.parts))
    return isinstance(distribution, TanhNormal)


def forbid(values: Array, mask: Array | None) -> Array:
    """Returns logits or values ``(..., n)`` with :data:`FORBIDDEN` where a mask, ``bool (..., n)``, forbids the action."""
    return values if mask is None else jnp.where(mask, values, jnp.float32(FORBIDDEN))


def log_tanh_slope(unsquashed: Array) -> Array:
    """Returns ``log(1 - tanh(u)^2)`` elementwise, without cancellation for large ``|u|``."""
    return 2.0 * (math.log(2.0) - unsquashed - jax.nn.softplus(-2.0 * unsquashed))


def sum_of(parts: list[Array]) -> Array:
    """Returns the sum of arrays of one shape."""
    return jnp.sum(jnp.stack(parts), axis=0)
