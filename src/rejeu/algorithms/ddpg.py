"""Deep deterministic policy gradient: a deterministic actor that climbs the critic's slope.

Source: Lillicrap et al. 2015, "Continuous control with deep reinforcement learning" (arXiv 1509.02971). With actor ``mu``,
critic ``Q``, their slowly moving targets ``mu'`` and ``Q'``, and discount ``d`` (0 where the MDP terminated)::

    y      = r + d Q'(s', mu'(s'))
    J_Q    = mean (Q(s, a) - y)^2
    J_mu   = -mean Q(s, mu(s))
    Q'    <- Q' + tau (Q - Q'),    mu' <- mu' + tau (mu - mu')     every target_update_interval-th update

Exploration is noise on actions or on parameters (``action_noise``). The actor ends in a tanh, which the loop scales to the
environment's bounds. As in Stable-Baselines3 the critic takes its step before the actor, and there is no weight decay.
For Discrete actions see :mod:`rejeu.algorithms.ddpg_discrete`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from gymnasium import spaces
from jax import Array

from rejeu.algorithms.config import OffPolicyConfig, with_widths
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
from rejeu.networks import Actor, Critic, Widths
from rejeu.schedules import Schedule, at
from rejeu.spaces import action_dimension, check_box_action, leaves
from rejeu.validation import whole
from rejeu.xla import outlined

HIDDEN_LAYERS = (400, 300)
"""Default widths of actor and critic but on images, those of the paper."""


@dataclass(frozen=True, kw_only=True)
class Config(OffPolicyConfig):
    """Hyper-parameters of DDPG; the defaults are those of Stable-Baselines3."""

    learning_rate: float | Schedule = 1e-3
    """Step size of Adam for both networks; a number, ``rejeu.Linear(start, end)``, ``rejeu.Exponential(start, end)`` or
    ``"lin_1e-3"``."""
    target_update_interval: int = 1
    """Gradient steps between two moves of both targets. Raising it is steadier and slower."""

    name: ClassVar[str] = "DDPG"
    hidden_layers: ClassVar[Widths] = Widths(HIDDEN_LAYERS, HIDDEN_LAYERS)
    hidden_layers_on_images: ClassVar[Widths] = OffPolicyConfig.hidden_layers

    def __post_init__(self) -> None:
        OffPolicyConfig.__post_init__(self)
        interval = whole("target_update_interval", self.target_update_interval, least=1)
        object.__setattr__(self, "target_update_interval", interval)


class State(eqx.Module):
    """Everything that DDPG learns, every leaf an array."""

    actor: Actor
    critic: Critic
    target_actor: Actor = eqx.field(metadata=AVERAGED)
    target_critic: Critic = eqx.field(metadata=AVERAGED)
    actor_optimizer: PyTree
    critic_optimizer: PyTree
    n_updates: Array
    """Gradient steps taken, ``int32[]``."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns DDPG for these spaces.

    Raises:
        ValueError: if the action space is neither a finite Box nor Discrete.
        TypeError: if the observation space holds something that is no array.
    """
    if isinstance(action_space, spaces.Discrete):
        from rejeu.algorithms import ddpg_discrete  # which imports this module

        return ddpg_discrete.make(config, observation_space, action_space)
    box = check_box_action(action_space, "DDPG")
    obs_leaves, action_dim = leaves(observation_space), action_dimension(box)
    shape = with_widths(config, obs_leaves).policy_kwargs
    optimizer = optax.scale_by_adam()

    def init(key: Array) -> State:
        actor_key, critic_key = jax.random.split(key)
        actor = Actor(actor_key, obs_leaves, action_dim, shape.actor_widths(HIDDEN_LAYERS), shape)
        critic = Critic(critic_key, obs_leaves, action_dim, shape.critic_widths(HIDDEN_LAYERS), shape)
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
        return policy(actor, obs)

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        rate = at(config.learning_rate, clock.progress)
        target = td_target(state.target_actor, state.target_critic, batch)
        (loss, values), gradients = value_and_grad(critic_loss, has_aux=True)(state.critic, batch, target)
        critic, critic_optimizer = descend(state.critic, gradients, state.critic_optimizer, optimizer, rate)
        policy_loss, gradients = value_and_grad(actor_loss)(state.actor, critic, batch.obs)
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
            "q_value": jnp.mean(values),
            TD_ERROR: jnp.abs(values - target),
        }
        return state, metrics

    def values(state: State, obs: PyTree, action: Array | None) -> Array:
        assert action is not None
        return action_value(state.critic, obs, action)[None]

    return Algorithm(init, lambda state: state.actor, explore, policy, update, action_values=values)


def policy(actor: Actor, obs: PyTree) -> Array:
    """Returns the actor's actions in [-1, 1], ``(batch, action_dim)``."""
    return jnp.tanh(actor(obs))


def action_value(critic: Critic, obs: PyTree, action: Array) -> Array:
    """Returns the critic's values, ``(batch,)``."""
    return critic(obs, action)[:, 0]


@outlined
def td_target(target_actor: Actor, target_critic: Critic, batch: Transition) -> Array:
    """Returns what the critic should say of the batch, ``(batch,)``."""
    next_value = action_value(target_critic, batch.next_obs, policy(target_actor, batch.next_obs))
    return batch.reward + batch.discount * next_value


def critic_loss(critic: Critic, batch: Transition, target: Array) -> tuple[Array, Array]:
    """Returns the mean squared TD error and the values, ``(batch,)``."""
    values = action_value(critic, batch.obs, batch.action)
    return weighted_mean(jnp.square(values - target), batch.weight), values


def actor_loss(actor: Actor, critic: Critic, obs: PyTree) -> Array:
    """Returns minus the mean value of the actor's own actions."""
    return -jnp.mean(action_value(critic, obs, policy(actor, obs)))
