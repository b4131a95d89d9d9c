"""Actor and critic for Discrete actions: DDPG whose actor is a classifier.

The actor ``mu(s)`` is a softmax over the actions and the training action is sampled from its probabilities; the critic
``Q(s)`` gives one value per action. With the target networks ``mu'`` and ``Q'`` the deterministic action of DDPG becomes the
probability vector, and its value the expectation under it, whose gradient is exact::

    y      = r + d sum_a mu'(a | s') Q'(s', a)
    J_Q    = mean (Q(s)[a] - y)^2
    J_mu   = -mean sum_a mu(a | s) Q(s, a) - ent_coef H(mu(. | s))

Nothing in plain DDPG keeps a classifier from becoming certain too early; a small entropy bonus with the fixed coefficient
``ENTROPY_COEFFICIENT`` does.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers
from rejeu.algorithms.config import network_inputs
from rejeu.algorithms.ddpg.continuous import HIDDEN_LAYERS, Config, State, initial_state, metrics_of, next_state
from rejeu.algorithms.sac.discrete import exploit, explore, imitation
from rejeu.core.algorithm import (
    Algorithm,
    Clock,
    Metrics,
    PyTree,
    Transition,
    minimize,
    weighted_mean,
    without_gradient,
)
from rejeu.core.schedules import at
from rejeu.networks import Network

ENTROPY_COEFFICIENT = 0.01
"""Weight of the actor's entropy in nats, in the unit of rewards."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Discrete) -> Algorithm:
    """Returns DDPG for Discrete actions."""
    obs_leaves, shape = network_inputs(config, observation_space)
    n_actions, optimizer = int(action_space.n), optimizers.make(config.optimizer, config.max_grad_norm)

    def init(key: Array) -> State:
        actor_key, critic_key = jax.random.split(key)
        actor = Network(actor_key, obs_leaves, n_actions, shape.actor_widths(HIDDEN_LAYERS), shape)
        critic = Network(critic_key, obs_leaves, n_actions, shape.critic_widths(HIDDEN_LAYERS), shape)
        return initial_state(actor, critic, optimizer)

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        rate = at(config.learning_rate, clock.progress)
        target = without_gradient(td_target)(state.target_actor, state.target_critic, batch)
        critic, critic_optimizer, loss, values = minimize(
            critic_loss, state.critic, state.critic_optimizer, optimizer, rate, batch, target
        )
        actor, actor_optimizer, policy_loss, entropy = minimize(
            actor_loss, state.actor, state.actor_optimizer, optimizer, rate, critic(batch.obs), batch.obs
        )
        metrics = metrics_of(loss, policy_loss, values, jnp.abs(values - target)) | {"entropy": entropy}
        return next_state(state, config, (actor, actor_optimizer), (critic, critic_optimizer)), metrics

    values = lambda state, obs, action: state.critic(obs)[None]  # noqa: E731
    return Algorithm(
        init, lambda state: state.actor, explore, exploit, update, action_values=values, imitation=imitation
    )


def td_target(target_actor: Network, target_critic: Network, batch: Transition) -> Array:
    """Returns the TD targets, ``(batch,)``."""
    probabilities = jax.nn.softmax(target_actor(batch.next_obs))
    return batch.reward + batch.discount * jnp.sum(probabilities * target_critic(batch.next_obs), axis=-1)


def critic_loss(critic: Network, batch: Transition, target: Array) -> tuple[Array, Array]:
    """Returns the mean squared TD error and the values of the actions taken, ``(batch,)``."""
    values = jnp.take_along_axis(critic(batch.obs), batch.action[:, None], axis=-1)[:, 0]
    return weighted_mean(jnp.square(values - target), batch.weight), values


def actor_loss(actor: Network, values: Array, obs: PyTree) -> tuple[Array, Array]:
    """Returns minus the expected value less the entropy bonus, and the mean entropy in nats.

    ``values`` are those of all actions, ``(batch, n_actions)``.
    """
    log_probabilities = jax.nn.log_softmax(actor(obs))
    probabilities = jnp.exp(log_probabilities)
    entropy = jnp.mean(-jnp.sum(probabilities * log_probabilities, axis=-1))
    return -jnp.mean(jnp.sum(probabilities * values, axis=-1)) - ENTROPY_COEFFICIENT * entropy, entropy
