"""Soft actor-critic for Discrete actions: expectations over actions are sums, so nothing needs to be drawn.

Source: Christodoulou 2019, "Soft Actor-Critic for Discrete Action Settings" (arXiv 1910.07207). With policy ``pi(a | s)``,
critics ``Q_i(s)`` of one value an action, slowly moving targets ``Q'_i``, temperature ``alpha`` and discount ``d``::

    V(s')    = sum_a pi(a | s') (min_i Q'_i(s', a) - alpha log pi(a | s'))
    J_Q      = sum_i mean (Q_i(s)[a] - (r + d V(s')))^2 / 2
    J_pi     = mean sum_a pi(a | s) (alpha log pi(a | s) - min_i Q_i(s, a))
    J_alpha  = mean log_alpha (H(pi(. | s)) - target_entropy)

``target_entropy="auto"`` is 0.3 log n rather than the paper's 0.98 log n, under which the policy stays nearly uniform
and, with few actions, never becomes good.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import optax
from gymnasium import spaces
from jax import Array

from rejeu.algorithms.sac import HIDDEN_LAYERS, Config, State, initial_temperature
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
from rejeu.networks import Actor
from rejeu.schedules import at
from rejeu.spaces import leaves
from rejeu.xla import outlined

TARGET_ENTROPY_SHARE = 0.3
"""Automatic target entropy as a share of the uniform policy's."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Discrete) -> Algorithm:
    """Returns SAC for Discrete actions."""
    obs_leaves, n_actions, shape = leaves(observation_space), int(action_space.n), config.policy_kwargs
    automatic = TARGET_ENTROPY_SHARE * math.log(n_actions)
    target_entropy = automatic if config.target_entropy == "auto" else float(config.target_entropy)
    optimizer = optax.scale_by_adam()

    def init(key: Array) -> State:
        actor_key, critics_key, update_key = jax.random.split(key, 3)
        actor = Actor(actor_key, obs_leaves, n_actions, shape.actor_widths(HIDDEN_LAYERS), shape)
        critics = ensemble(
            lambda k: Actor(k, obs_leaves, n_actions, shape.critic_widths(HIDDEN_LAYERS), shape),
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
        return jax.random.categorical(key, actor(obs)).astype(jnp.int32)

    def exploit(actor: Actor, obs: PyTree) -> Array:
        return jnp.argmax(actor(obs), axis=-1).astype(jnp.int32)

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        rate = at(config.learning_rate, clock.progress)
        alpha = jnp.exp(state.log_alpha)
        target = td_target(state.actor, state.target_critics, alpha, batch)
        (critic_loss, values), gradients = value_and_grad(critics_loss, has_aux=True)(state.critics, batch, target)
        critics, critics_optimizer = descend(state.critics, gradients, state.critics_optimizer, optimizer, rate)
        least_values = jnp.min(all_values(critics, batch.obs), axis=0)
        (policy_loss, entropy), gradients = value_and_grad(actor_loss, has_aux=True)(
            state.actor, least_values, alpha, batch.obs
        )
        actor, actor_optimizer = descend(state.actor, gradients, state.actor_optimizer, optimizer, rate)
        log_alpha, alpha_optimizer = state.log_alpha, state.alpha_optimizer
        if isinstance(config.ent_coef, str):
            gradient = jnp.mean(entropy) - target_entropy
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
        metrics = {
            "critic_loss": critic_loss,
            "actor_loss": policy_loss,
            "ent_coef": alpha,
            "entropy": jnp.mean(entropy),
            "q_value": jnp.mean(values),
            TD_ERROR: jnp.mean(jnp.abs(values - target[None]), axis=0),
        }
        return state, metrics

    def values(state: State, obs: PyTree, action: Array | None) -> Array:
        return all_values(state.critics, obs)

    return Algorithm(init, lambda state: state.actor, explore, exploit, update, action_values=values)


def all_values(critics: PyTree, obs: PyTree) -> Array:
    """Returns every critic's value of every action, ``(n_critics, batch, n_actions)``."""
    return jax.vmap(lambda critic: critic(obs))(critics)


@outlined
def td_target(actor: Actor, target_critics: PyTree, alpha: Array, batch: Transition) -> Array:
    """Returns what the critics should say of the batch, ``(batch,)``."""
    log_probabilities = jax.nn.log_softmax(actor(batch.next_obs))
    soft_values = jnp.min(all_values(target_critics, batch.next_obs), axis=0) - alpha * log_probabilities
    return batch.reward + batch.discount * jnp.sum(jnp.exp(log_probabilities) * soft_values, axis=-1)


def critics_loss(critics: PyTree, batch: Transition, target: Array) -> tuple[Array, Array]:
    """Returns half the squared TD error summed over critics, and the values of the actions, ``(n_critics, batch)``."""
    index = jnp.broadcast_to(
        batch.action[None, :, None], (jax.tree.leaves(critics)[0].shape[0], *batch.action.shape, 1)
    )
    values = jnp.take_along_axis(all_values(critics, batch.obs), index, axis=-1)[..., 0]
    return 0.5 * jnp.sum(weighted_mean(jnp.square(values - target[None]), batch.weight)), values


def actor_loss(actor: Actor, values: Array, alpha: Array, obs: PyTree) -> tuple[Array, Array]:
    """Returns the soft policy loss and the entropies in nats, ``(batch,)``; ``values`` is ``(batch, n_actions)``."""
    log_probabilities = jax.nn.log_softmax(actor(obs))
    probabilities = jnp.exp(log_probabilities)
    loss = jnp.mean(jnp.sum(probabilities * (alpha * log_probabilities - values), axis=-1))
    return loss, -jnp.sum(probabilities * log_probabilities, axis=-1)
