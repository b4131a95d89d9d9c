"""Proximal policy optimization: several epochs on each rollout, with the policy kept near the one that collected it.

Source: Schulman et al. 2017, "Proximal Policy Optimization Algorithms" (arXiv 1707.06347, equations 7 and 9), with the
advantages of Schulman et al. 2016 (see :mod:`rejeu.algorithms.actor_critic.gae`). With the policy ``pi``, the policy
``pi_old`` that collected the rollout, advantages ``A``, value ``V`` and its targets ``R = A + V_old``, over minibatches::

    ratio    = pi(a | s) / pi_old(a | s)
    J_pi     = -mean min(ratio A, clip(ratio, 1 - epsilon, 1 + epsilon) A)
    J_V      = mean (V(s) - R)^2;     with value clipping V is V_old + clip(V - V_old, -epsilon_V, epsilon_V)
    loss     = J_pi + vf_coef J_V - ent_coef mean entropy(pi(. | s))

Advantages are standardized in each minibatch; gradients are clipped to a norm; weights begin orthogonal: the details of
Huang et al. 2022, "The 37 Implementation Details of PPO". As in Stable-Baselines3, value clipping bounds the value
rather than taking the greater of two losses. Unlike there, log-probabilities and values of the rollout are computed at its
end in one pass, a last, smaller minibatch is padded and the padding is not counted, and Box actions are in [-1, 1] whatever
the environment's bounds are, so that one initial standard deviation suits all.

Updates stop early if the policy has moved further than ``1.5 target_kl``, measured on a minibatch by the estimate
``mean((ratio - 1) - log ratio)`` (Schulman 2020, "Approximating KL Divergence").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers, search
from rejeu.algorithms.actor_critic.config import OnPolicyConfig
from rejeu.algorithms.actor_critic.network import ActorCritic, algorithm_of, checked
from rejeu.algorithms.actor_critic.steps import (
    RolloutState as State,
    Samples,
    clip_and_descend,
    entropy_of,
    explained_variance,
    initial_state,
    masked_mean,
    mean_of_blocks,
    minibatches,
    samples,
    standardized,
    std_of,
)
from rejeu.algorithms.search import SearchSpace
from rejeu.core import schedules
from rejeu.core.algorithm import EXPLAINED_VARIANCE, GRADIENT_STEPS, Algorithm, Clock, Metrics, PyTree, Rollout, Scalar
from rejeu.core.prng import nth
from rejeu.core.schedules import Schedule, at
from rejeu.core.validation import coerce, number, whole

ADAM_EPSILON = 1e-5
"""Added to Adam's denominator, as in the authors' code."""
KL_FACTOR = 1.5
"""Multiple of ``target_kl`` at which the epochs stop."""


@dataclass(frozen=True, kw_only=True)
class Config(OnPolicyConfig):
    """Hyperparameters of PPO; the defaults are Stable-Baselines3's."""

    batch_size: int = 64
    """Steps per gradient step. Larger batches reduce the variance of the gradient at a higher cost."""
    n_epochs: int = 10
    """Passes over every rollout."""
    clip_range: float | Schedule = 0.2
    """Clip range of the ratio of probabilities, epsilon above. A larger value takes larger, riskier steps."""
    clip_range_vf: float | Schedule | None = None
    """Clip range of the value in one update, in the unit of rewards. None: no clipping."""
    target_kl: float | None = None
    """Stops the epochs once the KL divergence exceeds 1.5 times this value, in nats. None never stops."""

    name: ClassVar[str] = "PPO"
    search_space: ClassVar[SearchSpace] = search.PPO

    def __post_init__(self) -> None:
        OnPolicyConfig.__post_init__(self)
        coerce(self, ("batch_size", "n_epochs"), whole, least=1)
        coerce(self, "clip_range", schedules.parse, least=0)
        coerce(self, "clip_range_vf", schedules.parse, least=0, optional=True)
        coerce(self, "target_kl", number, above=0, optional=True)

    def steps_per_gradient(self, n_envs: int) -> int:
        """Returns the number of steps of ``n_envs`` environments per gradient step."""
        return min(self.batch_size, self.n_steps * n_envs)

    def gradient_steps(self, n: int) -> int:
        """Returns the number of gradient steps on a rollout of ``n`` steps, if nothing stops them early."""
        return self.n_epochs * -(-n // self.batch_size)

    @property
    def stops_early(self) -> bool:
        """Whether the policy's divergence may stop the epochs."""
        return self.target_kl is not None


class Losses(NamedTuple):
    """The losses of a minibatch, each ``float32[]``."""

    policy_loss: Array
    value_loss: Array
    entropy: Array
    approx_kl: Array
    clip_fraction: Array
    """Fraction of the ratios outside the clip range."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns PPO for these spaces.

    Raises:
        ValueError: if no policy can act in the action space, or if the settings do not fit the observation space.
    """
    obs_leaves, action_kind, shape = checked(config, observation_space, action_space)
    optimizer = optimizers.make(config.optimizer, eps=ADAM_EPSILON)

    def init(key: Array) -> State:
        return initial_state(
            key, lambda key: ActorCritic(key, obs_leaves, action_kind, shape, config.use_sde), optimizer
        )

    def update(state: State, rollout: Rollout, clock: Clock) -> tuple[State, Metrics]:
        data = samples(state.network, rollout, config.gae_lambda)
        order_key = nth(state.key, state.n_rollouts)
        minibatch, n_minibatches = minibatches(data, order_key, config.n_epochs, config.batch_size)
        network, optimizer_state, n_steps, losses = epochs(
            gradient, state.network, state.optimizer, minibatch, n_minibatches, optimizer, config, clock
        )
        state = state.after(network, optimizer_state, n_steps)
        return state, metrics_of(network, n_steps, losses, data.value, data.target, data.valid, config, clock)

    return algorithm_of(config, action_kind, init, update)


def metrics_of(
    network: PyTree,
    n_steps: Array,
    losses: Losses,
    value: Array,
    target: Array,
    valid: Array,
    config: Config,
    clock: Clock,
) -> Metrics:
    """Returns the metrics of an update, under the names of Stable-Baselines3."""
    ent_coef = at(config.ent_coef, clock.progress)
    return {
        "loss": losses.policy_loss + config.vf_coef * losses.value_loss - ent_coef * losses.entropy,
        "policy_gradient_loss": losses.policy_loss,
        "value_loss": losses.value_loss,
        "entropy_loss": -losses.entropy,
        "approx_kl": losses.approx_kl,
        "clip_fraction": losses.clip_fraction,
        "clip_range": jnp.asarray(at(config.clip_range, clock.progress), jnp.float32),
        GRADIENT_STEPS: n_steps.astype(jnp.float32),
        EXPLAINED_VARIANCE: explained_variance(value, target, valid),
        "learning_rate": jnp.asarray(at(config.learning_rate, clock.progress), jnp.float32),
        **std_of(network),
    }


def epochs(
    gradient: Callable[[PyTree, PyTree, PyTree, Clock], tuple[tuple[Array, Losses], PyTree]],
    network: PyTree,
    optimizer_state: PyTree,
    minibatch: Callable[[Array], PyTree],
    n_minibatches: Array,
    optimizer: optax.GradientTransformation,
    config: Config,
    clock: Clock,
) -> tuple[PyTree, PyTree, Array, Losses]:
    """Takes a gradient step on each minibatch, and returns network, optimizer, steps taken and mean losses.

    Args:
        gradient: the loss of a network on a minibatch, its parts, and its gradient.
        network: as it collected the rollout.
        optimizer_state: of ``optimizer``.
        minibatch: ``minibatch(i)`` returns the i-th of all epochs, as ``gradient`` takes it.
        n_minibatches: of all epochs, ``int32[]``.
        optimizer: without a learning rate.
        config: the hyperparameters.
        clock: the progress of the run.
    """

    def continues(carry: tuple[Array, Array, PyTree, PyTree, Losses]) -> Array:
        i, stopped, *_ = carry
        return (i < n_minibatches) & ~stopped

    def step(
        carry: tuple[Array, Array, PyTree, PyTree, Losses],
    ) -> tuple[Array, Array, PyTree, PyTree, Losses]:
        i, stopped, network, optimizer_state, sums = carry
        (_, losses), gradients = gradient(network, minibatch(i), config, clock)
        after, after_state = clip_and_descend(network, gradients, optimizer_state, optimizer, config, clock.progress)
        if config.target_kl is not None:
            stopped = losses.approx_kl > KL_FACTOR * config.target_kl
            after, after_state = jax.tree.map(
                lambda old, new: jnp.where(stopped, old, new), (network, optimizer_state), (after, after_state)
            )
        return i + 1, stopped, after, after_state, jax.tree.map(jnp.add, sums, losses)

    zero = Losses(*[jnp.float32(0)] * len(Losses._fields))
    begin = (jnp.int32(0), jnp.bool(False), network, optimizer_state, zero)
    i, stopped, network, optimizer_state, sums = jax.lax.while_loop(continues, step, begin)
    return network, optimizer_state, i - stopped, jax.tree.map(lambda total: total / jnp.maximum(i, 1), sums)


def gradient(
    network: ActorCritic, batch: Samples, config: Config, clock: Clock
) -> tuple[tuple[Array, Losses], ActorCritic]:
    """Returns the total loss of a minibatch, its parts, and its gradient (see the docstring of this module)."""

    def loss(network: ActorCritic, block: Samples) -> tuple[Array, Losses]:
        return loss_of(*network.both(block.obs), block, config, clock)

    of_block = jax.value_and_grad(loss, has_aux=True)
    return mean_of_blocks(lambda block: of_block(network, block), scaled(batch, config))


def scaled(batch: Samples, config: Config) -> Samples:
    """Returns a minibatch with its advantages as the loss takes them."""
    if not config.normalize_advantage:
        return batch
    return batch._replace(advantage=standardized(batch.advantage, batch.valid))


def loss_of(distribution: Any, value: Array, batch: Samples, config: Config, clock: Clock) -> tuple[Array, Losses]:
    """Returns the total loss of :func:`scaled` steps and its parts from the outputs of the network."""
    log_prob = distribution.log_prob(batch.action)
    clip = at(config.clip_range, clock.progress)
    # Padding may hold anything: a ratio that overflows there would make the gradient NaN, although it does not count.
    log_ratio = jnp.where(batch.valid, log_prob - batch.log_prob, 0.0)
    ratio = jnp.exp(log_ratio)
    policy_loss = masked_mean(surrogate(ratio, batch.advantage, clip), batch.valid)
    if config.clip_range_vf is not None:
        reach = at(config.clip_range_vf, clock.progress)
        value = batch.value + jnp.clip(value - batch.value, -reach, reach)
    value_loss = masked_mean(jnp.square(value - batch.target), batch.valid)
    entropy = masked_mean(entropy_of(distribution, log_prob), batch.valid)
    total = policy_loss + config.vf_coef * value_loss - at(config.ent_coef, clock.progress) * entropy
    approx_kl = masked_mean((ratio - 1.0) - log_ratio, batch.valid)
    clip_fraction = masked_mean((jnp.abs(ratio - 1.0) > clip).astype(jnp.float32), batch.valid)
    return total, Losses(policy_loss, value_loss, entropy, approx_kl, clip_fraction)


def surrogate(ratio: Array, advantage: Array, clip: Scalar) -> Array:
    """Returns the clipped policy loss of each step (arXiv 1707.06347, equation 7, negated)."""
    return -jnp.minimum(ratio * advantage, jnp.clip(ratio, 1.0 - clip, 1.0 + clip) * advantage)
