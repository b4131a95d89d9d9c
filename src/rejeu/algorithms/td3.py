"""Twin delayed deep deterministic policy gradient: DDPG with two critics, smoothed targets and a slower actor.

Source: Fujimoto et al. 2018, "Addressing Function Approximation Error in Actor-Critic Methods" (arXiv 1802.09477). With
actor ``mu``, critics ``Q_i``, their slowly moving targets ``mu'`` and ``Q'_i``, and discount ``d`` (0 where the MDP
terminated)::

    a'     = clip(mu'(s') + clip(eps, -c, c), -1, 1),    eps ~ N(0, sigma)
    y      = r + d min_i Q'_i(s', a')
    J_Q    = sum_i mean (Q_i(s, a) - y)^2
    J_mu   = -mean Q_1(s, mu(s))                          every policy_delay-th update, with the moves of all targets

Everything else is as in :mod:`rejeu.algorithms.ddpg`, Stable-Baselines3's order of steps included.
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
from rejeu.algorithms.ddpg import HIDDEN_LAYERS, actor_loss, policy
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
    ensemble,
    polyak,
    value_and_grad,
    weighted_mean,
)
from rejeu.networks import Actor, Critic, Widths, action_values
from rejeu.prng import nth
from rejeu.schedules import Schedule, at
from rejeu.spaces import action_dimension, check_box_action, leaves
from rejeu.validation import number, whole
from rejeu.xla import outlined


@dataclass(frozen=True, kw_only=True)
class Config(OffPolicyConfig):
    """Hyper-parameters of TD3; the defaults are those of Stable-Baselines3."""

    learning_rate: float | Schedule = 1e-3
    """Step size of Adam for every network; a number, ``rejeu.Linear(start, end)``, ``rejeu.Exponential(start, end)`` or
    ``"lin_1e-3"``."""
    policy_delay: int = 2
    """Gradient steps of the critics to one of the actor and the targets."""
    target_policy_noise: float = 0.2
    """Standard deviation of the noise on the target's actions, in the scale of actions in [-1, 1]."""
    target_noise_clip: float = 0.5
    """Largest size of that noise."""
    n_critics: int = 2
    """Number of critics; the least of their values is the target."""

    name: ClassVar[str] = "TD3"
    hidden_layers: ClassVar[Widths] = Widths(HIDDEN_LAYERS, HIDDEN_LAYERS)
    hidden_layers_on_images: ClassVar[Widths] = OffPolicyConfig.hidden_layers

    def __post_init__(self) -> None:
        OffPolicyConfig.__post_init__(self)
        for key in ("policy_delay", "n_critics"):
            object.__setattr__(self, key, whole(key, getattr(self, key), least=1))
        for key in ("target_policy_noise", "target_noise_clip"):
            object.__setattr__(self, key, number(key, getattr(self, key), least=0))


class State(eqx.Module):
    """Everything that TD3 learns, every leaf an array."""

    actor: Actor
    critics: Critic
    """All critics, stacked along a leading axis."""
    target_actor: Actor = eqx.field(metadata=AVERAGED)
    target_critics: Critic = eqx.field(metadata=AVERAGED)
    actor_optimizer: PyTree
    critics_optimizer: PyTree
    actor_loss: Array
    """Of the actor's last step, ``float32[]``: there is none in between."""
    key: Array
    """Root of the randomness of the updates, ``uint32[2]``; never changes."""
    n_updates: Array
    """Gradient steps of the critics taken, ``int32[]``."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns TD3 for these spaces.

    Raises:
        ValueError: if the action space is not a finite Box.
        TypeError: if the observation space holds something that is no array.
    """
    box = check_box_action(action_space, "TD3")
    obs_leaves, action_dim = leaves(observation_space), action_dimension(box)
    shape = with_widths(config, obs_leaves).policy_kwargs
    optimizer = optax.scale_by_adam()

    def init(key: Array) -> State:
        actor_key, critics_key, update_key = jax.random.split(key, 3)
        actor = Actor(actor_key, obs_leaves, action_dim, shape.actor_widths(HIDDEN_LAYERS), shape)
        critics = ensemble(
            lambda k: Critic(k, obs_leaves, action_dim, shape.critic_widths(HIDDEN_LAYERS), shape),
            critics_key,
            config.n_critics,
        )
        return State(
            actor=actor,
            critics=critics,
            target_actor=copy(actor),
            target_critics=copy(critics),
            actor_optimizer=optimizer.init(actor),
            critics_optimizer=optimizer.init(critics),
            actor_loss=jnp.float32(0.0),
            key=update_key,
            n_updates=jnp.int32(0),
        )

    def explore(actor: Actor, obs: PyTree, key: Array, clock: Clock) -> Array:
        return policy(actor, obs)

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        rate = at(config.learning_rate, clock.progress)
        next_action = smoothed_action(
            state.target_actor,
            batch.next_obs,
            nth(state.key, state.n_updates),
            config.target_policy_noise,
            config.target_noise_clip,
        )
        target = td_target(state.target_critics, batch, next_action)
        (loss, values), gradients = value_and_grad(critics_loss, has_aux=True)(state.critics, batch, target)
        critics, critics_optimizer = descend(state.critics, gradients, state.critics_optimizer, optimizer, rate)
        n_updates = state.n_updates + 1

        def delayed(state: State) -> State:
            first_critic = jax.tree.map(lambda leaf: leaf[0], critics)
            policy_loss, gradients = value_and_grad(actor_loss)(state.actor, first_critic, batch.obs)
            actor, actor_optimizer = descend(state.actor, gradients, state.actor_optimizer, optimizer, rate)
            return eqx.tree_at(
                lambda s: (s.actor, s.actor_optimizer, s.actor_loss, s.target_actor, s.target_critics),
                state,
                (
                    actor,
                    actor_optimizer,
                    policy_loss,
                    polyak(state.target_actor, actor, config.tau),
                    polyak(state.target_critics, critics, config.tau),
                ),
            )

        state = eqx.tree_at(
            lambda s: (s.critics, s.critics_optimizer, s.n_updates), state, (critics, critics_optimizer, n_updates)
        )
        state = jax.lax.cond(n_updates % config.policy_delay == 0, delayed, lambda s: s, state)
        metrics = {
            "critic_loss": loss,
            "actor_loss": state.actor_loss,
            "q_value": jnp.mean(values),
            TD_ERROR: jnp.mean(jnp.abs(values - target[None]), axis=0),
        }
        return state, metrics

    def values(state: State, obs: PyTree, action: Array | None) -> Array:
        assert action is not None
        return action_values(state.critics, obs, action)

    return Algorithm(init, lambda state: state.actor, explore, policy, update, action_values=values)


@outlined
def smoothed_action(target_actor: Actor, next_obs: PyTree, key: Array, sigma: float, clip: float) -> Array:
    """Returns the target actor's actions with clipped noise, in [-1, 1], ``(batch, action_dim)``."""
    action = policy(target_actor, next_obs)
    noise = jnp.clip(sigma * jax.random.normal(key, action.shape), -clip, clip)
    return jnp.clip(action + noise, -1.0, 1.0)


@outlined
def td_target(target_critics: Critic, batch: Transition, next_action: Array) -> Array:
    """Returns what the critics should say of the batch, ``(batch,)``."""
    next_value = jnp.min(action_values(target_critics, batch.next_obs, next_action), axis=0)
    return batch.reward + batch.discount * next_value


def critics_loss(critics: Critic, batch: Transition, target: Array) -> tuple[Array, Array]:
    """Returns the mean squared TD errors summed over the critics, and the values, ``(n_critics, batch)``."""
    values = action_values(critics, batch.obs, batch.action)
    return jnp.sum(weighted_mean(jnp.square(values - target[None]), batch.weight)), values
