"""Truncated quantile critics: SAC whose critics learn the distribution of the return and forget its upper tail.

Source: Kuznetsov et al. 2020, "Controlling Overestimation Bias with Truncated Mixture of Continuous Distributional
Quantile Critics" (arXiv 2005.04269). Each of N critics gives M quantiles ``z_n(s, a)`` of the return; their targets
``z'_n`` follow slowly. With policy ``pi``, temperature ``alpha`` and discount ``d`` (0 where the MDP terminated)::

    z_(1) <= z_(2) <= ...   = all N M quantiles z'_n(s', a') together, in order,      a' ~ pi(. | s')
    y_i         = r + d (z_(i) - alpha log pi(a' | s')),                              i = 1 .. N (M - dropped)
    J_Z         = sum_n mean rho(y_i - z_n(s, a)),                                    the quantile Huber loss
    J_pi        = mean (alpha log pi(a | s) - mean of all quantiles z_n(s, a)),       a ~ pi(. | s), reparameterised

Policy, temperature, targets and the order of the steps are SAC's (:mod:`rejeu.algorithms.sac`). As there, the critics'
losses are summed, which gives each the gradient of its own; Stable-Baselines3 Contrib takes their mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import optax
from gymnasium import spaces
from jax import Array

from rejeu.algorithms.config import OffPolicyConfig
from rejeu.algorithms.quantile_loss import quantile_huber_loss
from rejeu.algorithms.sac import HIDDEN_LAYERS, State, initial_temperature, policy, temperature_loss
from rejeu.core import (
    TD_ERROR,
    Algorithm,
    Clock,
    Metrics,
    PyTree,
    Transition,
    copy,
    descend,
    ensemble,
    polyak,
    tau_at,
    value_and_grad,
    weighted_mean,
)
from rejeu.networks import Actor, Critic
from rejeu.prng import nth
from rejeu.schedules import at
from rejeu.spaces import action_dimension, check_box_action, leaves
from rejeu.validation import number, whole
from rejeu.xla import outlined


@dataclass(frozen=True, kw_only=True)
class Config(OffPolicyConfig):
    """Hyper-parameters of TQC; the defaults are those of Stable-Baselines3 Contrib."""

    n_quantiles: int = 25
    """Quantiles that each critic predicts. Raising it describes the return more finely, at its price."""
    top_quantiles_to_drop_per_net: int = 2
    """Quantiles that each critic's share of the target loses at the top. Raising it is more pessimistic."""
    n_critics: int = 2
    """Number of critics, whose quantiles are pooled."""
    ent_coef: float | str = "auto"
    """Temperature of the entropy bonus: ``"auto"`` learns it from 1, ``"auto_0.1"`` from 0.1, a number fixes it.
    Raising it explores more."""
    target_entropy: float | str = "auto"
    """Entropy in nats that the automatic temperature steers to; ``"auto"`` is minus the number of action dimensions."""
    target_update_interval: int = 1
    """Gradient steps between two moves of the target critics."""

    name: ClassVar[str] = "TQC"

    def __post_init__(self) -> None:
        OffPolicyConfig.__post_init__(self)
        initial_temperature(self.ent_coef)
        if self.target_entropy != "auto":
            object.__setattr__(self, "target_entropy", number("target_entropy", self.target_entropy))
        for key in ("n_quantiles", "n_critics", "target_update_interval"):
            object.__setattr__(self, key, whole(key, getattr(self, key), least=1))
        dropped = whole("top_quantiles_to_drop_per_net", self.top_quantiles_to_drop_per_net, least=0)
        if dropped >= self.n_quantiles:
            raise ValueError(
                f"top_quantiles_to_drop_per_net={dropped} would leave nothing of n_quantiles={self.n_quantiles}; "
                f"use at most {self.n_quantiles - 1}"
            )
        object.__setattr__(self, "top_quantiles_to_drop_per_net", dropped)


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns TQC for these spaces; its state is SAC's, with critics of ``n_quantiles`` outputs.

    Raises:
        ValueError: if the action space is not a finite Box.
        TypeError: if the observation space holds something that is no array.
    """
    box = check_box_action(action_space, "TQC")
    obs_leaves, action_dim, shape = leaves(observation_space), action_dimension(box), config.policy_kwargs
    target_entropy = -float(action_dim) if config.target_entropy == "auto" else float(config.target_entropy)
    n_kept = config.n_critics * (config.n_quantiles - config.top_quantiles_to_drop_per_net)
    optimizer = optax.scale_by_adam()

    def init(key: Array) -> State:
        actor_key, critics_key, update_key = jax.random.split(key, 3)
        actor = Actor(actor_key, obs_leaves, 2 * action_dim, shape.actor_widths(HIDDEN_LAYERS), shape)
        widths = shape.critic_widths(HIDDEN_LAYERS)
        critics = ensemble(
            lambda k: Critic(k, obs_leaves, action_dim, widths, shape, config.n_quantiles),
            critics_key,
            config.n_critics,
        )
        log_alpha = jnp.log(jnp.float32(initial_temperature(config.ent_coef)))
        return State(
            actor=actor,
            critics=critics,
            target_critics=copy(critics),
            log_alpha=log_alpha,
            actor_optimizer=optimizer.init(actor),
            critics_optimizer=optimizer.init(critics),
            alpha_optimizer=optimizer.init(log_alpha),
            key=update_key,
            n_updates=jnp.int32(0),
        )

    def explore(actor: Actor, obs: PyTree, key: Array, clock: Clock) -> Array:
        return policy(actor, obs).sample(key)

    def exploit(actor: Actor, obs: PyTree) -> Array:
        return policy(actor, obs).mode()

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        target_key, actor_key = jax.random.split(nth(state.key, state.n_updates))
        rate = at(config.learning_rate, clock.progress)
        alpha = jnp.exp(state.log_alpha)
        target = td_target(state.actor, state.target_critics, alpha, batch, target_key, n_kept)
        (critic_loss, quantiles), gradients = value_and_grad(critics_loss, has_aux=True)(state.critics, batch, target)
        critics, critics_optimizer = descend(state.critics, gradients, state.critics_optimizer, optimizer, rate)
        (policy_loss, log_prob), gradients = value_and_grad(actor_loss, has_aux=True)(
            state.actor, critics, alpha, batch.obs, actor_key
        )
        actor, actor_optimizer = descend(state.actor, gradients, state.actor_optimizer, optimizer, rate)

        log_alpha, alpha_optimizer = state.log_alpha, state.alpha_optimizer
        if isinstance(config.ent_coef, str):
            gradient = jax.grad(temperature_loss)(log_alpha, log_prob, target_entropy)
            log_alpha, alpha_optimizer = descend(log_alpha, gradient, alpha_optimizer, optimizer, rate)

        n_updates = state.n_updates + 1
        tau = tau_at(n_updates, config.tau, config.target_update_interval)
        state = State(
            actor=actor,
            critics=critics,
            target_critics=polyak(state.target_critics, critics, tau),
            log_alpha=log_alpha,
            actor_optimizer=actor_optimizer,
            critics_optimizer=critics_optimizer,
            alpha_optimizer=alpha_optimizer,
            key=state.key,
            n_updates=n_updates,
        )
        values = jnp.mean(quantiles, axis=-1)
        metrics = {
            "critic_loss": critic_loss,
            "actor_loss": policy_loss,
            "ent_coef": alpha,
            "entropy": -jnp.mean(log_prob),
            "q_value": jnp.mean(values),
            TD_ERROR: jnp.mean(jnp.abs(values - jnp.mean(target, axis=-1)[None]), axis=0),
        }
        return state, metrics

    def values(state: State, obs: PyTree, action: Array | None) -> Array:
        assert action is not None
        return jnp.mean(action_quantiles(state.critics, obs, action), axis=-1)

    return Algorithm(init, lambda state: state.actor, explore, exploit, update, action_values=values)


def action_quantiles(critics: Critic, obs: PyTree, action: Array) -> Array:
    """Returns the quantiles that each of the stacked critics gives, ``(n_critics, batch, n_quantiles)``, unordered."""
    return jax.vmap(lambda critic: critic(obs, action))(critics)


def truncate(quantiles: Array, n_kept: int) -> Array:
    """Returns the ``n_kept`` smallest of all critics' quantiles, ascending, ``(batch, n_kept)``.

    >>> truncate(jnp.array([[[3.0, 1.0]], [[2.0, 9.0]]]), 3).tolist()
    [[1.0, 2.0, 3.0]]
    """
    pooled = jnp.swapaxes(quantiles, 0, 1).reshape(quantiles.shape[1], -1)
    return -jax.lax.top_k(-pooled, n_kept)[0]


@outlined
def td_target(actor: Actor, target_critics: Critic, alpha: Array, batch: Transition, key: Array, n_kept: int) -> Array:
    """Returns samples of the return that the critics should predict, ``(batch, n_kept)``."""
    next_action, next_log_prob = policy(actor, batch.next_obs).sample_and_log_prob(key)
    kept = truncate(action_quantiles(target_critics, batch.next_obs, next_action), n_kept)
    return batch.reward[:, None] + batch.discount[:, None] * (kept - (alpha * next_log_prob)[:, None])


def critics_loss(critics: Critic, batch: Transition, target: Array) -> tuple[Array, Array]:
    """Returns the quantile Huber loss, averaged over the batch and summed over critics, and the critics' quantiles."""
    quantiles = action_quantiles(critics, batch.obs, batch.action)
    return jnp.sum(weighted_mean(quantile_huber_loss(quantiles, target), batch.weight)), quantiles


def actor_loss(actor: Actor, critics: Critic, alpha: Array, obs: PyTree, key: Array) -> tuple[Array, Array]:
    """Returns the soft policy loss and the log-probabilities of the actions drawn, ``(batch,)``.

    The value of an action is the mean of all quantiles, none left out.
    """
    action, log_prob = policy(actor, obs).sample_and_log_prob(key)
    value = jnp.mean(action_quantiles(critics, obs, action), axis=(0, 2))
    return jnp.mean(alpha * log_prob - value), log_prob
