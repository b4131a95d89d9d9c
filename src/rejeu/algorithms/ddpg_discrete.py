"""Actor and critic for Discrete actions: DDPG whose actor is a classifier.

The actor ``mu(s)`` is a softmax over the actions and the training action is drawn from its probabilities; the critic ``Q(s)``
gives one value an action. With the slowly moving targets ``mu'`` and ``Q'`` the deterministic action of DDPG becomes the
probability vector, and its value the expectation under it, which the actor's gradient flows through exactly::

    y      = r + d sum_a mu'(a | s') Q'(s', a)
    J_Q    = mean (Q(s)[a] - y)^2
    J_mu   = -mean sum_a mu(a | s) Q(s, a) - ent_coef H(mu(. | s))

Nothing in plain DDPG keeps a classifier from becoming certain too early; a small entropy bonus with the fixed coefficient
``ENTROPY_COEFFICIENT`` does.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from gymnasium import spaces
from jax import Array

from rejeu.algorithms.config import with_widths
from rejeu.algorithms.ddpg import HIDDEN_LAYERS, Config
from rejeu.core import (
    AVERAGED,
    TD_ERROR,
    Algorithm,
    Clock,
    Metrics,
    PyTree,
    Transition,
    copy,
    descend,
    polyak,
    tau_at,
    value_and_grad,
    weighted_mean,
)
from rejeu.networks import Actor
from rejeu.schedules import at
from rejeu.spaces import leaves
from rejeu.xla import outlined

ENTROPY_COEFFICIENT = 0.01
"""Weight of the actor's entropy in nats, in the unit of rewards."""


class State(eqx.Module):
    """Everything that is learnt, every leaf an array."""

    actor: Actor
    critic: Actor
    """Values of all actions, ``(batch, n_actions)``."""
    target_actor: Actor = eqx.field(metadata=AVERAGED)
    target_critic: Actor = eqx.field(metadata=AVERAGED)
    actor_optimizer: PyTree
    critic_optimizer: PyTree
    n_updates: Array
    """Gradient steps taken, ``int32[]``."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Discrete) -> Algorithm:
    """Returns DDPG for Discrete actions."""
    obs_leaves, n_actions = leaves(observation_space), int(action_space.n)
    shape = with_widths(config, obs_leaves).policy_kwargs
    optimizer = optax.scale_by_adam()

    def init(key: Array) -> State:
        actor_key, critic_key = jax.random.split(key)
        actor = Actor(actor_key, obs_leaves, n_actions, shape.actor_widths(HIDDEN_LAYERS), shape)
        critic = Actor(critic_key, obs_leaves, n_actions, shape.critic_widths(HIDDEN_LAYERS), shape)
        return State(
            actor=actor,
            critic=critic,
            target_actor=copy(actor),
            target_critic=copy(critic),
            actor_optimizer=optimizer.init(actor),
            critic_optimizer=optimizer.init(critic),
            n_updates=jnp.int32(0),
        )

    def explore(actor: Actor, obs: PyTree, key: Array, clock: Clock) -> Array:
        return jax.random.categorical(key, actor(obs)).astype(jnp.int32)

    def exploit(actor: Actor, obs: PyTree) -> Array:
        return jnp.argmax(actor(obs), axis=-1).astype(jnp.int32)

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        rate = at(config.learning_rate, clock.progress)
        target = td_target(state.target_actor, state.target_critic, batch)
        (loss, values), gradients = value_and_grad(critic_loss, has_aux=True)(state.critic, batch, target)
        critic, critic_optimizer = descend(state.critic, gradients, state.critic_optimizer, optimizer, rate)
        (policy_loss, entropy), gradients = value_and_grad(actor_loss, has_aux=True)(
            state.actor, critic(batch.obs), batch.obs
        )
        actor, actor_optimizer = descend(state.actor, gradients, state.actor_optimizer, optimizer, rate)
        n_updates = state.n_updates + 1
        tau = tau_at(n_updates, config.tau, config.target_update_interval)
        state = State(
            actor=actor,
            critic=critic,
            target_actor=polyak(state.target_actor, actor, tau),
            target_critic=polyak(state.target_critic, critic, tau),
            actor_optimizer=actor_optimizer,
            critic_optimizer=critic_optimizer,
            n_updates=n_updates,
        )
        metrics = {
            "critic_loss": loss,
            "actor_loss": policy_loss,
            "entropy": entropy,
            "q_value": jnp.mean(values),
            TD_ERROR: jnp.abs(values - target),
        }
        return state, metrics

    def values(state: State, obs: PyTree, action: Array | None) -> Array:
        return state.critic(obs)[None]

    return Algorithm(init, lambda state: state.actor, explore, exploit, update, action_values=values)


@outlined
def td_target(target_actor: Actor, target_critic: Actor, batch: Transition) -> Array:
    """Returns what the critic should say of the batch, ``(batch,)``."""
    probabilities = jax.nn.softmax(target_actor(batch.next_obs))
    return batch.reward + batch.discount * jnp.sum(probabilities * target_critic(batch.next_obs), axis=-1)


def critic_loss(critic: Actor, batch: Transition, target: Array) -> tuple[Array, Array]:
    """Returns the mean squared TD error and the values of the actions taken, ``(batch,)``."""
    values = jnp.take_along_axis(critic(batch.obs), batch.action[:, None], axis=-1)[:, 0]
    return weighted_mean(jnp.square(values - target), batch.weight), values


def actor_loss(actor: Actor, values: Array, obs: PyTree) -> tuple[Array, Array]:
    """Returns minus the expected value less the entropy bonus, and the mean entropy in nats.

    ``values`` are those of all actions, ``(batch, n_actions)``.
    """
    log_probabilities = jax.nn.log_softmax(actor(obs))
    probabilities = jnp.exp(log_probabilities)
    entropy = jnp.mean(-jnp.sum(probabilities * log_probabilities, axis=-1))
    return -jnp.mean(jnp.sum(probabilities * values, axis=-1)) - ENTROPY_COEFFICIENT * entropy, entropy
