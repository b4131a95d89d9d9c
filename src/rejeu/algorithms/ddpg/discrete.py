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

from rejeu.algorithms.ddpg.continuous import Config, make_with
from rejeu.algorithms.sac.discrete import exploit, explore, imitation
from rejeu.core.algorithm import Algorithm, Metrics, PyTree, Transition, weighted_mean
from rejeu.networks import Network

ENTROPY_COEFFICIENT = 0.01
"""Weight of the actor's entropy in nats, in the unit of rewards."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Discrete) -> Algorithm:
    """Returns DDPG for Discrete actions."""
    values = lambda state, obs, action: state.critic(obs)[None]  # noqa: E731
    parts = make_with(config, observation_space, int(action_space.n), Network, td_target, critic_loss, actor_loss)
    return Algorithm(*parts[:2], explore, exploit, parts[2], action_values=values, imitation=imitation)


def td_target(target_actor: Network, target_critic: Network, batch: Transition) -> Array:
    """Returns the TD targets, ``(batch,)``."""
    probabilities = jax.nn.softmax(target_actor(batch.next_obs))
    return batch.reward + batch.discount * jnp.sum(probabilities * target_critic(batch.next_obs), axis=-1)


def critic_loss(critic: Network, batch: Transition, target: Array) -> tuple[Array, Array]:
    """Returns the mean squared TD error and the values of the actions taken, ``(batch,)``."""
    values = jnp.take_along_axis(critic(batch.obs), batch.action[:, None], axis=-1)[:, 0]
    return weighted_mean(jnp.square(values - target), batch.weight), values


def actor_loss(actor: Network, critic: Network, obs: PyTree) -> tuple[Array, Metrics]:
    """Returns minus the expected value less the entropy bonus, and the mean entropy in nats."""
    values = critic(obs)
    log_probabilities = jax.nn.log_softmax(actor(obs))
    probabilities = jnp.exp(log_probabilities)
    entropy = jnp.mean(-jnp.sum(probabilities * log_probabilities, axis=-1))
    loss = -jnp.mean(jnp.sum(probabilities * values, axis=-1)) - ENTROPY_COEFFICIENT * entropy
    return loss, {"entropy": entropy}
