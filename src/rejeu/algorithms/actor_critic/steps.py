"""The steps of a rollout as the losses need them, and what losses and updates compute of them."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rejeu.algorithms.actor_critic.gae import advantages
from rejeu.algorithms.actor_critic.network import ActorCritic, Distribution
from rejeu.core import PyTree, Rollout
from rejeu.distributions import TanhNormal, sum_of


class Samples(NamedTuple):
    """The steps of a rollout as the losses need them, leaves ``(batch, ...)``."""

    obs: PyTree
    action: Array
    log_prob: Array
    """Of the action under the policy that chose it, in nats."""
    value: Array
    """Of the observation before any update."""
    advantage: Array
    target: Array
    """What the value should have been: advantage plus value (the lambda-return)."""
    valid: Array
    """Whether the step exists, ``bool``."""


def samples(network: ActorCritic, rollout: Rollout, gae_lambda: float) -> Samples:
    """Returns the steps of a rollout in one row, environment by environment within a step, and their advantages.

    Values and log-probabilities are computed here, in one pass over all steps, rather than while acting: the network is
    still the one that acted.
    """
    shape = rollout.reward.shape
    flat = jax.tree.map(
        lambda x: x.reshape(shape[0] * shape[1], *x.shape[2:]), rollout._replace(started=None, carry=())
    )
    distribution, value = network.both(flat.obs)
    next_value = network.value(flat.next_obs)
    last = jnp.concatenate([~rollout.valid[1:], jnp.ones_like(rollout.valid[:1])])
    advantage = advantages(
        rollout.reward,
        value.reshape(shape),
        next_value.reshape(shape),
        rollout.discount,
        rollout.ended | last,
        gae_lambda,
    ).reshape(-1)
    log_prob = distribution.log_prob(flat.action)
    return Samples(flat.obs, flat.action, log_prob, value, advantage, advantage + value, flat.valid)


def entropy_of(distribution: Distribution, log_prob: Array) -> Array:
    """Returns the entropy, ``(batch,)``; of a squashed normal, which has none in closed form, its estimate -log pi."""
    return -log_prob if isinstance(distribution, TanhNormal) else distribution.entropy()


def clipped(gradients: PyTree, most: float | None) -> tuple[PyTree, Array]:
    """Returns ``gradients`` scaled down to the norm ``most`` if they are longer (None: never), and their norm before."""
    norm = jnp.sqrt(sum_of([jnp.sum(jnp.square(g)) for g in jax.tree.leaves(gradients)]))
    if most is None:
        return gradients, norm
    factor = jnp.minimum(1.0, most / (norm + 1e-6))
    return jax.tree.map(lambda g: g * factor, gradients), norm


def explained_variance(predicted: Array, target: Array, valid: Array) -> Array:
    """Returns ``1 - Var(target - predicted) / Var(target)`` over the valid entries; NaN where the target is constant."""
    spread = masked_variance(target, valid)
    return jnp.where(spread > 0, 1.0 - masked_variance(target - predicted, valid) / spread, jnp.nan)


def masked_mean(values: Array, valid: Array) -> Array:
    """Returns the mean over the entries where ``valid``; 0 where there is none."""
    return jnp.sum(jnp.where(valid, values, 0.0)) / jnp.maximum(jnp.sum(valid), 1)


def masked_variance(values: Array, valid: Array) -> Array:
    """Returns the variance over the entries where ``valid``, divided by their number."""
    return masked_mean(jnp.square(values - masked_mean(values, valid)), valid)


def standardised(values: Array, valid: Array) -> Array:
    """Returns ``values`` with mean 0 and standard deviation 1 over the entries where ``valid``.

    Where only one is valid, which has no deviation, ``values`` are left as they are.
    """
    scaled = (values - masked_mean(values, valid)) / (jnp.sqrt(masked_variance(values, valid)) + 1e-8)
    return jnp.where(jnp.sum(valid) > 1, scaled, values)
