"""Proximal policy optimisation: several epochs over each rollout, the policy held near the one that collected it.

Source: Schulman et al. 2017, "Proximal Policy Optimization Algorithms" (arXiv 1707.06347, equations 7 and 9), with the
advantages of Schulman et al. 2016 (see :mod:`rejeu.algorithms.actor_critic.gae`). With the policy ``pi``, the policy
``pi_old`` that collected the rollout, advantages ``A``, value ``V`` and its targets ``R = A + V_old``, over minibatches::

    ratio    = pi(a | s) / pi_old(a | s)
    J_pi     = -mean min(ratio A, clip(ratio, 1 - epsilon, 1 + epsilon) A)
    J_V      = mean (V(s) - R)^2;     with value clipping V is V_old + clip(V - V_old, -epsilon_V, epsilon_V)
    loss     = J_pi + vf_coef J_V - ent_coef mean entropy(pi(. | s))

Advantages are standardised in each minibatch; gradients are clipped to a norm; weights begin orthogonal: the details of
Huang et al. 2022, "The 37 Implementation Details of PPO". As in Stable-Baselines3, value clipping bounds the value
rather than taking the greater of two losses. Unlike there, log-probabilities and values of the rollout are computed at its
end in one pass, a last minibatch that is not full counts only what it holds, and Box actions live in [-1, 1] whatever the
environment's bounds are, so that one initial standard deviation suits all.

Updates stop early where the policy has moved further than ``1.5 target_kl``, measured on a minibatch by the estimate
``mean((ratio - 1) - log ratio)`` (Schulman 2020, "Approximating KL Divergence").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from gymnasium import spaces
from jax import Array

from rejeu import schedules
from rejeu.algorithms.actor_critic import (
    ActorCritic,
    OnPolicyConfig,
    Samples,
    action_kind,
    check_value_rate,
    clipped,
    entropy_of,
    explained_variance,
    explorer_of,
    is_value,
    masked_mean,
    samples,
    standardised,
)
from rejeu.algorithms.config import with_widths
from rejeu.core import Algorithm, Clock, Metrics, PyTree, Rollout
from rejeu.prng import nth
from rejeu.schedules import Schedule, at
from rejeu.spaces import check_action, leaves
from rejeu.validation import number, whole

ADAM_EPSILON = 1e-5
"""Added to Adam's denominator, as in the authors' code."""
KL_FACTOR = 1.5
"""How many times ``target_kl`` the policy may move before the epochs stop."""


@dataclass(frozen=True, kw_only=True)
class Config(OnPolicyConfig):
    """Hyper-parameters of PPO; the defaults are Stable-Baselines3's."""

    batch_size: int = 64
    """Steps per gradient step. Raising it gives a steadier, dearer step."""
    n_epochs: int = 10
    """Passes over every rollout. Raising it learns more from each, until the clipping stops it."""
    clip_range: float | Schedule = 0.2
    """How far the ratio of probabilities may move for gain, epsilon above. Raising it takes larger, riskier steps."""
    clip_range_vf: float | Schedule | None = None
    """How far the value may move in one update, in the reward's unit. None leaves it free."""
    target_kl: float | None = None
    """Stops the epochs once the policy has moved 1.5 times this far, in nats. None never stops."""

    name: ClassVar[str] = "PPO"

    def __post_init__(self) -> None:
        OnPolicyConfig.__post_init__(self)
        put = lambda key, value: object.__setattr__(self, key, value)  # noqa: E731
        for key in ("batch_size", "n_epochs"):
            put(key, whole(key, getattr(self, key), least=1))
        for key in ("clip_range", "clip_range_vf"):
            value = getattr(self, key)
            if key == "clip_range" or value is not None:
                put(key, schedules.parse(key, value))
                if min(schedules.at(getattr(self, key), end) for end in (0.0, 1.0)) < 0:
                    raise ValueError(f"{key}={value!r} must not fall below 0")
        if self.target_kl is not None:
            put("target_kl", number("target_kl", self.target_kl, above=0))

    def steps_per_gradient(self, n_envs: int) -> int:
        """Returns how many steps of ``n_envs`` environments one gradient is taken on."""
        return min(self.batch_size, self.n_steps * n_envs)

    def learns_from_part(self, n: int, n_envs: int) -> bool:
        """Returns whether an incomplete rollout of ``n`` steps is learned from when ``learn`` ends: from a minibatch on."""
        return n >= self.batch_size

    def gradient_steps(self, n: int) -> int:
        """Returns how many gradient steps a rollout of ``n`` steps is worth, if nothing stops them early."""
        return self.n_epochs * -(-n // self.batch_size)

    @property
    def stops_early(self) -> bool:
        """Whether the policy's divergence may stop the epochs."""
        return self.target_kl is not None


class State(eqx.Module):
    """Everything that PPO learns, every leaf an array."""

    network: Any
    """Policy and value, an :class:`ActorCritic` or, with a memory, a ``RecurrentActorCritic``."""
    optimizer: PyTree
    key: Array
    n_updates: Array
    """Gradient steps so far, ``int32[]``."""
    n_rollouts: Array
    """Rollouts learnt from so far, ``int32[]``."""


class Losses(NamedTuple):
    """What a minibatch came to, each ``float32[]``."""

    policy_loss: Array
    value_loss: Array
    entropy: Array
    approx_kl: Array
    clip_fraction: Array
    """Share of the ratios beyond the clip range."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns PPO for these spaces.

    Raises:
        ValueError: if no policy can act in the action space, or if the settings do not fit the observation space.
    """
    check_action(action_space, config.name)
    obs_leaves, kind = leaves(observation_space), action_kind(action_space)
    check_value_rate(config, obs_leaves)
    shape = with_widths(config, obs_leaves).policy_kwargs
    optimizer = optax.scale_by_adam(eps=ADAM_EPSILON)

    def init(key: Array) -> State:
        network_key, update_key = jax.random.split(key)
        network = ActorCritic(network_key, obs_leaves, kind, shape, config.use_sde)
        return State(network, optimizer.init(network), update_key, jnp.int32(0), jnp.int32(0))

    def explore(actor: ActorCritic, obs: PyTree, key: Array, clock: Clock) -> Array:
        return actor.policy(obs).sample(key)

    def exploit(actor: ActorCritic, obs: PyTree) -> Array:
        return actor.policy(obs).mode()

    def update(state: State, rollout: Rollout, clock: Clock) -> tuple[State, Metrics]:
        data = samples(state.network, rollout, config.gae_lambda)
        n = data.valid.shape[0]
        size = min(config.batch_size, n)
        n_valid = jnp.sum(data.valid)
        n_batches = (n_valid + size - 1) // size
        orders = shuffled(nth(state.key, state.n_rollouts), data.valid, config.n_epochs, -n % size)

        def minibatch(i: Array) -> Samples:
            first = (i % n_batches) * size
            index = jax.lax.dynamic_slice(orders, (i // n_batches, first), (1, size))[0]
            chosen = jax.tree.map(lambda x: x[index], data)
            return chosen._replace(valid=first + jnp.arange(size) < n_valid)

        network, optimizer_state, n_steps, losses = epochs(
            loss, state.network, state.optimizer, minibatch, config.n_epochs * n_batches, optimizer, config, clock
        )
        state = State(network, optimizer_state, state.key, state.n_updates + n_steps, state.n_rollouts + 1)
        return state, metrics_of(network, n_steps, losses, data.value, data.target, data.valid, config, clock)

    def value(carry: PyTree, network: ActorCritic, obs: PyTree, ended: Array) -> Array:
        return network.value(obs)

    explorer = explorer_of(config, kind)
    return Algorithm(init, lambda state: state.network, explore, exploit, update, explorer, state_value=value)


def metrics_of(
    network: Any,
    n_steps: Array,
    losses: Losses,
    value: Array,
    target: Array,
    valid: Array,
    config: Config,
    clock: Clock,
) -> Metrics:
    """Returns what is reported of an update."""
    metrics = losses._asdict()
    metrics["gradient_steps"] = n_steps.astype(jnp.float32)
    metrics["explained_variance"] = explained_variance(value, target, valid)
    metrics["learning_rate"] = jnp.asarray(at(config.learning_rate, clock.progress), jnp.float32)
    if network.log_std is not None:
        metrics["std"] = jnp.mean(jnp.exp(network.log_std))
    return metrics


def shuffled(key: Array, valid: Array, n_epochs: int, n_padding: int) -> Array:
    """Returns for every epoch an order of all steps at random, the valid ones first, ``int32 (n_epochs, n + padding)``."""
    drawn = jax.random.uniform(key, (n_epochs, valid.shape[0])) + jnp.where(valid, 0.0, 2.0)[None]
    return jnp.pad(jnp.argsort(drawn, axis=1).astype(jnp.int32), ((0, 0), (0, n_padding)))


def epochs(
    loss: Callable[[Any, Any, Any, Clock], tuple[Array, Losses]],
    network: Any,
    optimizer_state: PyTree,
    minibatch: Callable[[Array], Any],
    n_minibatches: Array,
    optimizer: optax.GradientTransformation,
    config: Config,
    clock: Clock,
) -> tuple[Any, PyTree, Array, Losses]:
    """Takes a gradient step on each minibatch, and returns network, optimizer, steps taken and mean losses.

    Args:
        loss: of a network on a minibatch, and its parts.
        network: as it collected the rollout.
        optimizer_state: of ``optimizer``.
        minibatch: ``minibatch(i)`` returns the i-th of all epochs, as ``loss`` takes it.
        n_minibatches: of all epochs, ``int32[]``.
        optimizer: without a learning rate.
        config: the hyper-parameters.
        clock: where the run stands.
    """
    value_flags = is_value(network)

    def goes_on(carry: tuple[Array, Array, Any, PyTree, Losses]) -> Array:
        i, stopped, *_ = carry
        return (i < n_minibatches) & ~stopped

    def step(
        carry: tuple[Array, Array, Any, PyTree, Losses],
    ) -> tuple[Array, Array, Any, PyTree, Losses]:
        i, stopped, network, optimizer_state, sums = carry
        (_, losses), gradients = jax.value_and_grad(loss, has_aux=True)(network, minibatch(i), config, clock)
        after, after_state = descend(network, optimizer_state, gradients, value_flags, optimizer, config, clock)
        if config.target_kl is not None:
            stopped = losses.approx_kl > KL_FACTOR * config.target_kl
            after, after_state = jax.tree.map(
                lambda old, new: jnp.where(stopped, old, new), (network, optimizer_state), (after, after_state)
            )
        return i + 1, stopped, after, after_state, jax.tree.map(jnp.add, sums, losses)

    zero = Losses(*[jnp.float32(0)] * len(Losses._fields))
    begin = (jnp.int32(0), jnp.bool(False), network, optimizer_state, zero)
    i, stopped, network, optimizer_state, sums = jax.lax.while_loop(goes_on, step, begin)
    return network, optimizer_state, i - stopped, jax.tree.map(lambda total: total / jnp.maximum(i, 1), sums)


def loss(network: ActorCritic, batch: Samples, config: Config, clock: Clock) -> tuple[Array, Losses]:
    """Returns the whole loss of a minibatch, and its parts (see the top of this file)."""
    distribution, value = network.both(batch.obs)
    return loss_of(distribution, value, batch, config, clock)


def loss_of(distribution: Any, value: Array, batch: Samples, config: Config, clock: Clock) -> tuple[Array, Losses]:
    """Returns the same from what the network made of the observations."""
    log_prob = distribution.log_prob(batch.action)
    advantage = standardised(batch.advantage, batch.valid) if config.normalize_advantage else batch.advantage
    clip = at(config.clip_range, clock.progress)
    # Padding may hold anything: a ratio that overflows there would turn the gradient to NaN, though it is not counted.
    log_ratio = jnp.where(batch.valid, log_prob - batch.log_prob, 0.0)
    ratio = jnp.exp(log_ratio)
    policy_loss = masked_mean(surrogate(ratio, advantage, clip), batch.valid)
    if config.clip_range_vf is not None:
        reach = at(config.clip_range_vf, clock.progress)
        value = batch.value + jnp.clip(value - batch.value, -reach, reach)
    value_loss = masked_mean(jnp.square(value - batch.target), batch.valid)
    entropy = masked_mean(entropy_of(distribution, log_prob), batch.valid)
    total = policy_loss + config.vf_coef * value_loss - at(config.ent_coef, clock.progress) * entropy
    approx_kl = masked_mean((ratio - 1.0) - log_ratio, batch.valid)
    clip_fraction = masked_mean((jnp.abs(ratio - 1.0) > clip).astype(jnp.float32), batch.valid)
    return total, Losses(policy_loss, value_loss, entropy, approx_kl, clip_fraction)


def surrogate(ratio: Array, advantage: Array, clip: Any) -> Array:
    """Returns the clipped policy loss of each step (arXiv 1707.06347, equation 7, negated)."""
    return -jnp.minimum(ratio * advantage, jnp.clip(ratio, 1.0 - clip, 1.0 + clip) * advantage)


def descend(
    network: ActorCritic,
    optimizer_state: PyTree,
    gradients: ActorCritic,
    value_flags: ActorCritic,
    optimizer: optax.GradientTransformation,
    config: OnPolicyConfig,
    clock: Clock,
) -> tuple[ActorCritic, PyTree]:
    """Returns network and optimizer state after one step against the clipped gradients.

    Where the value has a learning rate of its own it also has a norm of its own; as Adam treats every weight by itself,
    that makes two optimizers of one.
    """
    rate = at(config.learning_rate, clock.progress)
    if config.critic_learning_rate is None:
        gradients, _ = clipped(gradients, config.max_grad_norm)
        direction, optimizer_state = optimizer.update(gradients, optimizer_state, network)
        return jax.tree.map(lambda p, d: p - rate * d, network, direction), optimizer_state
    value_rate = at(config.critic_learning_rate, clock.progress)
    of_value, of_policy = eqx.partition(gradients, value_flags)
    gradients = eqx.combine(clipped(of_value, config.max_grad_norm)[0], clipped(of_policy, config.max_grad_norm)[0])
    direction, optimizer_state = optimizer.update(gradients, optimizer_state, network)
    step = lambda p, d, is_value: p - (value_rate if is_value else rate) * d  # noqa: E731
    return jax.tree.map(step, network, direction, value_flags), optimizer_state
