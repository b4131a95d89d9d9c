"""Deep deterministic policy gradient: a deterministic actor trained by the critic's gradient.

Source: Lillicrap et al. 2015, "Continuous control with deep reinforcement learning" (arXiv 1509.02971). With actor ``mu``,
critic ``Q``, target networks ``mu'`` and ``Q'``, and discount ``d`` (0 where the MDP terminated)::

    y      = r + d Q'(s', mu'(s'))
    J_Q    = mean (Q(s, a) - y)^2
    J_mu   = -mean Q(s, mu(s))
    Q'    <- Q' + tau (Q - Q'),    mu' <- mu' + tau (mu - mu')     every target_update_interval-th update

Exploration is noise on actions or on parameters (``action_noise``). The actor ends in a tanh, which the loop scales to the
environment's bounds. As in Stable-Baselines3 the critic takes its step before the actor, and there is no weight decay.
For Discrete actions see :mod:`rejeu.algorithms.ddpg.discrete`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers
from rejeu.algorithms.config import network_inputs
from rejeu.algorithms.ddpg.state import HIDDEN_LAYERS, Config, State, initial_state, metrics_of, next_state
from rejeu.core import (
    Algorithm,
    Clock,
    Metrics,
    PyTree,
    Transition,
    descend,
    minimize,
    value_and_grad,
    weighted_mean,
    without_gradient,
)
from rejeu.networks import Network, QNetwork
from rejeu.schedules import at
from rejeu.spaces import action_dimension, check_box_action


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns DDPG for Box actions."""
    action_dim = action_dimension(check_box_action(action_space, config.name))
    obs_leaves, shape = network_inputs(config, observation_space)
    optimizer = optimizers.make(config.optimizer)

    def init(key: Array) -> State:
        actor_key, critic_key = jax.random.split(key)
        actor = Network(actor_key, obs_leaves, action_dim, shape.actor_widths(HIDDEN_LAYERS), shape)
        critic = QNetwork(critic_key, obs_leaves, action_dim, shape.critic_widths(HIDDEN_LAYERS), shape)
        return initial_state(actor, critic, optimizer)

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        rate = at(config.learning_rate, clock.progress)
        target = without_gradient(td_target)(state.target_actor, state.target_critic, batch)
        critic, critic_optimizer, loss, values = minimize(
            critic_loss, state.critic, state.critic_optimizer, optimizer, rate, batch, target
        )
        policy_loss, gradients = value_and_grad(actor_loss)(state.actor, critic, batch.obs)
        actor, actor_optimizer = descend(state.actor, gradients, state.actor_optimizer, optimizer, rate)
        metrics = metrics_of(loss, policy_loss, values, jnp.abs(values - target))
        return next_state(state, config, (actor, actor_optimizer), (critic, critic_optimizer)), metrics

    values = lambda state, obs, action: action_value(state.critic, obs, action)[None]  # noqa: E731
    return Algorithm(init, lambda state: state.actor, explore, policy, update, action_values=values)


def explore(actor: Network, obs: PyTree, key: Array, clock: Clock) -> Array:
    """Returns the actor's actions; exploration noise is added by :mod:`rejeu.exploration`."""
    return policy(actor, obs)


def policy(actor: Network, obs: PyTree) -> Array:
    """Returns the actor's actions in [-1, 1], ``(batch, action_dim)``."""
    return jnp.tanh(actor(obs))


def action_value(critic: QNetwork, obs: PyTree, action: Array) -> Array:
    """Returns the critic's values, ``(batch,)``."""
    return critic(obs, action)[:, 0]


def td_target(target_actor: Network, target_critic: QNetwork, batch: Transition) -> Array:
    """Returns the TD targets, ``(batch,)``."""
    next_value = action_value(target_critic, batch.next_obs, policy(target_actor, batch.next_obs))
    return batch.reward + batch.discount * next_value


def critic_loss(critic: QNetwork, batch: Transition, target: Array) -> tuple[Array, Array]:
    """Returns the mean squared TD error and the values, ``(batch,)``."""
    values = action_value(critic, batch.obs, batch.action)
    return weighted_mean(jnp.square(values - target), batch.weight), values


def actor_loss(actor: Network, critic: QNetwork, obs: PyTree) -> Array:
    """Returns minus the mean value of the actor's own actions."""
    return -jnp.mean(action_value(critic, obs, policy(actor, obs)))
