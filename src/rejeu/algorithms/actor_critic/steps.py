"""The steps of a rollout as the losses take them, their minibatches, and the computations that losses and updates share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax import Array

from rejeu.algorithms.actor_critic.config import OnPolicyConfig
from rejeu.algorithms.actor_critic.gae import advantages
from rejeu.algorithms.actor_critic.network import ActorCritic, Distribution, is_value
from rejeu.core.algorithm import PyTree, Rollout, clip, descend
from rejeu.core.distributions import is_squashed
from rejeu.core.schedules import at

D = TypeVar("D")
MOST_PACKED = 2**14
"""Steps of a rollout up to which they are shuffled as single words, which leaves 17 bits or more for the random number."""


class Samples(NamedTuple):
    """The steps of a rollout as the losses take them, leaves ``(batch, ...)``."""

    obs: PyTree
    action: Array
    log_prob: Array
    """Of the action under the policy that chose it, in nats."""
    value: Array
    """Of the observation before any update."""
    advantage: Array
    target: Array
    """Target of the value: advantage plus value (the lambda-return)."""
    valid: Array
    """Whether the step exists, ``bool``."""


def flat(tree: PyTree) -> PyTree:
    """Returns leaves ``(steps, n_envs, ...)`` as ``(steps * n_envs, ...)``."""
    return jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), tree)


def samples(network: ActorCritic, rollout: Rollout, gae_lambda: float) -> Samples:
    """Returns the steps of a rollout along one axis, with their advantages.

    Values and log-probabilities are computed here, in one pass over all steps, rather than when acting: the network is
    still the one that chose the actions.
    """
    shape = rollout.reward.shape
    distribution, value = network.both(flat(rollout.obs))
    next_value = network.value(flat(rollout.next_obs))
    log_prob = distribution.log_prob(flat(rollout.action))
    evaluated = [x.reshape(shape) for x in (log_prob, value, next_value)]
    return flat(with_advantages(rollout, gae_lambda, *evaluated))


def with_advantages(rollout: Rollout, gae_lambda: float, log_prob: Array, value: Array, next_value: Array) -> Samples:
    """Returns the steps of a rollout with what the network gives for them, leaves ``(steps, n_envs, ...)``."""
    last = jnp.concatenate([~rollout.valid[1:], jnp.ones_like(rollout.valid[:1])])
    ends = rollout.ended | last
    advantage = advantages(rollout.reward, value, next_value, rollout.discount, ends, gae_lambda)
    return Samples(rollout.obs, rollout.action, log_prob, value, advantage, advantage + value, rollout.valid)


def entropy_of(distribution: Distribution, log_prob: Array) -> Array:
    """Returns the entropy, ``(batch,)``; of a squashed normal, which has none in closed form, its estimate -log pi."""
    return -log_prob if is_squashed(distribution) else distribution.entropy()  # type: ignore[union-attr]


def clip_and_descend(
    network: Any,
    gradients: Any,
    optimizer_state: PyTree,
    optimizer: optax.GradientTransformation,
    config: OnPolicyConfig,
    progress: Any,
) -> tuple[Any, PyTree]:
    """Returns network and optimizer state after one step against gradients whose norm is limited.

    A value with a learning rate of its own also has a norm of its own.
    """
    rate = at(config.learning_rate, progress)
    if config.critic_learning_rate is None:
        return descend(network, clip(gradients, None, config.max_grad_norm), optimizer_state, optimizer, rate)
    belongs_to_value, value_rate = is_value(network), at(config.critic_learning_rate, progress)
    parts = [clip(part, None, config.max_grad_norm) for part in eqx.partition(gradients, belongs_to_value)]
    rates = jax.tree.map(lambda own: value_rate if own else rate, belongs_to_value)
    return descend(network, eqx.combine(*parts), optimizer_state, optimizer, rates)


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


def standardized(values: Array, valid: Array) -> Array:
    """Returns ``values`` with mean 0 and standard deviation 1 over the entries where ``valid``.

    Where only one is valid, which has no deviation, ``values`` are left as they are.
    """
    scaled = (values - masked_mean(values, valid)) / (jnp.sqrt(masked_variance(values, valid)) + 1e-8)
    return jnp.where(jnp.sum(valid) > 1, scaled, values)


def minibatches(data: D, key: Array, n_epochs: int, batch_size: int) -> tuple[Callable[[Array], D], Array]:
    """Returns the minibatches of all epochs as a function of their number, and how many there are, ``int32[]``.

    Args:
        data: the steps of a rollout, a NamedTuple of leaves ``(n, ...)`` with a field ``valid``, which says which steps
            there are. A minibatch has the same fields; those that it lacks of ``batch_size`` are not valid in it.
        key: of the random order.
        n_epochs: passes over all steps.
        batch_size: steps of a minibatch; fewer if the rollout has fewer.
    """
    steps: Any = data
    n = steps.valid.shape[0]
    size = min(batch_size, n)
    n_valid = jnp.sum(steps.valid, dtype=jnp.int32)
    n_batches = (n_valid + size - 1) // size
    orders = shuffled(key, steps.valid, n_epochs, -n % size)

    def minibatch(i: Array) -> D:
        first = (i % n_batches) * size
        index = jax.lax.dynamic_slice(orders, (i // n_batches, first), (1, size))[0]
        chosen = jax.tree.map(lambda x: x[index], steps)
        return chosen._replace(valid=first + jnp.arange(size) < n_valid)

    return minibatch, n_epochs * n_batches


def shuffled(key: Array, valid: Array, n_epochs: int, n_padding: int) -> Array:
    """Returns a random order of all steps for every epoch, the valid ones first, ``int32 (n_epochs, n + padding)``.

    Up to ``MOST_PACKED`` steps each is one word, with random bits above its own index, because XLA sorts single words on a
    CPU four times as fast as pairs. Of equal random bits, the smaller index comes first.
    """
    n = valid.shape[0]
    if n > MOST_PACKED:
        drawn = jax.random.uniform(key, (n_epochs, n)) + jnp.where(valid, 0.0, 2.0)[None]
        orders = jnp.argsort(drawn, axis=1).astype(jnp.int32)
    else:
        width = jnp.uint32((n - 1).bit_length())
        drawn = jax.random.bits(key, (n_epochs, n), jnp.uint32) >> (width + 1) << width
        is_missing = jnp.where(valid, 0, jnp.uint32(1) << 31)
        words = drawn | (is_missing | jnp.arange(n, dtype=jnp.uint32))[None]
        orders = (jnp.sort(words, axis=1) & ((jnp.uint32(1) << width) - 1)).astype(jnp.int32)
    return jnp.pad(orders, ((0, 0), (0, n_padding)))
