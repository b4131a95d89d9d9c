"""Implicit Q-learning: learns from recorded actions alone, without ever asking for the value of others.

Source: Kostrikov et al. 2022, "Offline Reinforcement Learning with Implicit Q-Learning" (arXiv 2110.06169). With critics
``Q_i``, targets ``Q'_i``, value ``V``, policy ``pi``, and discount ``d`` (0 where the MDP terminated)::

    A      = min_i Q'_i(s, a) - V(s)
    J_V    = mean |expectile - 1[A < 0]| A^2                                                   equation 5
    J_Q    = sum_i mean (Q_i(s, a) - r - d V(s'))^2                                            equation 6
    J_pi   = -mean min(exp(inverse_temperature A), 100) log pi(a|s)                            equation 7
    Q'    <- Q' + tau (Q - Q')

``V`` takes its step first, then the policy and the critics with the new ``V``, as in the authors' code. The policy is a
normal distribution with the mean ``tanh`` of the network and a standard deviation that does not depend on the state. All
networks have the same learning rate; that of the authors' policy falls to 0 along a cosine. It is meant for
:func:`rejeu.demonstrations.learn_offline`; training in an environment continues from there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers, search
from rejeu.algorithms.config import OffPolicyConfig, network_inputs
from rejeu.algorithms.td3 import critics_loss
from rejeu.core.algorithm import (
    AVERAGED,
    TD_ERROR,
    Algorithm,
    Clock,
    Metrics,
    PyTree,
    Transition,
    copy,
    minimize,
    polyak,
)
from rejeu.core.distributions import Normal
from rejeu.core.schedules import at
from rejeu.core.spaces import action_dimension, check_box_action
from rejeu.core.validation import coerce, number, whole
from rejeu.networks import Network, QNetwork, action_values, actor_and_critics, values_by_critics

LOG_STD_RANGE = (-5.0, 2.0)
"""Limits of the policy's log standard deviation; those of the authors' code."""
MOST_WEIGHT = 100.0
"""Upper limit on the weight of an action; that of the authors' code."""


@dataclass(frozen=True, kw_only=True)
class Config(OffPolicyConfig):
    """Hyperparameters of IQL; the defaults are those of the paper for locomotion."""

    expectile: float = 0.7
    """Which expectile of the recorded actions' values the value is, in (0, 1]. 0.5 is their mean; a larger one comes closer to
    the best of them."""
    inverse_temperature: float = 3.0
    """How much more likely good actions become than bad ones. 0 is behavior cloning."""
    n_critics: int = 2
    """Number of critics; the least of their targets counts."""

    name: ClassVar[str] = "IQL"
    search_space: ClassVar[search.SearchSpace] = {
        **search.OFFLINE,
        "expectile": search.Uniform(0.5, 0.95),
        "inverse_temperature": search.LogUniform(0.3, 30.0),
    }

    def __post_init__(self) -> None:
        OffPolicyConfig.__post_init__(self)
        coerce(self, "expectile", number, above=0, most=1)
        coerce(self, "inverse_temperature", number, least=0)
        coerce(self, "n_critics", whole, least=1)


class Actor(eqx.Module):
    """Observation to a normal distribution of actions."""

    network: Network
    log_std: Array
    """``(action_dim,)``."""

    def policy(self, obs: PyTree) -> Normal:
        """Returns the distribution at observations ``(batch, ...)``."""
        return Normal(jnp.tanh(self.network(obs)), jnp.clip(self.log_std, *LOG_STD_RANGE)[None])


class State(eqx.Module):
    """Everything that IQL learns; every leaf is an array."""

    actor: Actor
    critics: QNetwork
    """All critics, stacked along a leading axis."""
    value: Network
    target_critics: QNetwork = eqx.field(metadata=AVERAGED)
    actor_optimizer: PyTree
    critics_optimizer: PyTree
    value_optimizer: PyTree


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns IQL for these spaces.

    Raises:
        ValueError: if the action space is not a finite Box.
        TypeError: if the observation space holds something that is not an array.
    """
    action_dim = action_dimension(check_box_action(action_space, config.name))
    obs_leaves, shape = inputs = network_inputs(config, observation_space)
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm)
    network, make_critics = actor_and_critics(inputs, action_dim, config.n_critics, QNetwork, action_dim)

    def init(key: Array) -> State:
        actor_key, critics_key, value_key = jax.random.split(key, 3)
        actor, critics = Actor(network(actor_key), jnp.zeros((action_dim,), jnp.float32)), make_critics(critics_key)
        value = Network(value_key, obs_leaves, 1, shape.critic_widths(), shape)
        return State(actor, critics, value, copy(critics), *map(optimizer.init, (actor, critics, value)))

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        rate = at(config.learning_rate, clock.progress)
        recorded = jnp.min(action_values(state.target_critics, batch.obs, batch.action), axis=0)
        value, value_optimizer, loss, _ = minimize(
            value_loss, state.value, state.value_optimizer, optimizer, rate, batch.obs, recorded, config.expectile
        )
        weight = jnp.exp(config.inverse_temperature * (recorded - value(batch.obs)[:, 0]))
        actor, actor_optimizer, policy_loss, _ = minimize(
            actor_loss, state.actor, state.actor_optimizer, optimizer, rate, batch, jnp.minimum(weight, MOST_WEIGHT)
        )
        target = batch.reward + batch.discount * value(batch.next_obs)[:, 0]
        critics, critics_optimizer, critic_loss, values = minimize(
            critics_loss, state.critics, state.critics_optimizer, optimizer, rate, batch, target
        )
        targets = polyak(state.target_critics, critics, config.tau)
        metrics = {
            "critic_loss": critic_loss,
            "actor_loss": policy_loss,
            "value_loss": loss,
            "q_value": jnp.mean(values),
            TD_ERROR: jnp.mean(jnp.abs(values - target[None]), axis=0),
        }
        return State(actor, critics, value, targets, actor_optimizer, critics_optimizer, value_optimizer), metrics

    return Algorithm(init, lambda state: state.actor, explore, exploit, update, action_values=values_by_critics)


def explore(actor: Actor, obs: PyTree, key: Array, clock: Clock) -> Array:
    """Returns actions sampled from the policy, within [-1, 1], ``(batch, action_dim)``."""
    return jnp.clip(actor.policy(obs).sample(key), -1.0, 1.0)


def exploit(actor: Actor, obs: PyTree) -> Array:
    """Returns the means of the policy, ``(batch, action_dim)``."""
    return actor.policy(obs).mode()


def value_loss(value: Network, obs: PyTree, recorded: Array, expectile: float) -> tuple[Array, None]:
    """Returns the expectile loss of the value for the values of recorded actions, ``(batch,)``."""
    advantage = recorded - value(obs)[:, 0]
    return jnp.mean(jnp.abs(expectile - (advantage < 0)) * jnp.square(advantage)), None


def actor_loss(actor: Actor, batch: Transition, weight: Array) -> tuple[Array, None]:
    """Returns minus the log-probabilities of recorded actions, weighted by ``weight`` ``(batch,)``."""
    return -jnp.mean(weight * actor.policy(batch.obs).log_prob(batch.action)), None
