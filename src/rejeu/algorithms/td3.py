"""Twin delayed deep deterministic policy gradient: DDPG with two critics, smoothed targets and delayed actor updates.

Source: Fujimoto et al. 2018, "Addressing Function Approximation Error in Actor-Critic Methods" (arXiv 1802.09477). With
actor ``mu``, critics ``Q_i``, target networks ``mu'`` and ``Q'_i``, and discount ``d`` (0 where the MDP
terminated)::

    a'     = clip(mu'(s') + clip(eps, -c, c), -1, 1),    eps ~ N(0, sigma)
    y      = r + d min_i Q'_i(s', a')
    J_Q    = sum_i mean (Q_i(s, a) - y)^2
    J_mu   = -mean Q_1(s, mu(s))                          every policy_delay-th update, with the targets' updates

Everything else is as in :mod:`rejeu.algorithms.ddpg`, Stable-Baselines3's order of steps included.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers
from rejeu.algorithms.config import network_inputs
from rejeu.algorithms.ddpg.continuous import DeterministicPolicyConfig, actor_loss, explore, metrics_of, policy
from rejeu.algorithms.memory import acting_from_memory
from rejeu.core.algorithm import (
    AVERAGED,
    Algorithm,
    Clock,
    Metrics,
    PyTree,
    Transition,
    copy,
    descend,
    minimize,
    polyak,
    value_and_grad,
    weighted_mean,
    without_gradient,
)
from rejeu.core.prng import nth
from rejeu.core.schedules import at
from rejeu.core.spaces import action_dimension, check_box_action
from rejeu.core.validation import coerce, number, whole
from rejeu.networks import Network, QNetwork, action_values, actor_and_critics, first, values_by_critics


@dataclass(frozen=True, kw_only=True)
class Config(DeterministicPolicyConfig):
    """Hyperparameters of TD3; the defaults are those of Stable-Baselines3."""

    policy_delay: int = 2
    """Gradient steps of the critics per step of the actor and update of the targets."""
    target_policy_noise: float = 0.2
    """Standard deviation of the noise on the target's actions, in the scale of actions in [-1, 1]."""
    target_noise_clip: float = 0.5
    """Largest size of that noise."""
    n_critics: int = 2
    """Number of critics; the target is the minimum of their values."""

    can_remember: ClassVar[bool] = True
    name: ClassVar[str] = "TD3"

    def __post_init__(self) -> None:
        DeterministicPolicyConfig.__post_init__(self)
        coerce(self, ("policy_delay", "n_critics"), whole, least=1)
        coerce(self, ("target_policy_noise", "target_noise_clip"), number, least=0)


class State(eqx.Module):
    """Everything that TD3 learns; every leaf is an array."""

    actor: Network
    critics: QNetwork
    """All critics, stacked along a leading axis."""
    target_actor: Network = eqx.field(metadata=AVERAGED)
    target_critics: QNetwork = eqx.field(metadata=AVERAGED)
    actor_optimizer: PyTree
    critics_optimizer: PyTree
    actor_loss: Array
    """Loss of the actor's last step, ``float32[]``."""
    key: Array
    """Root of the random numbers of the updates, ``uint32[2]``; never changes."""
    n_updates: Array
    """Gradient steps of the critics taken, ``int32[]``."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns TD3 for these spaces.

    Raises:
        ValueError: if the action space is not a finite Box.
        TypeError: if the observation space holds something that is not an array.
    """
    return make_with(config, observation_space, action_space, policy_loss, td_target)


def make_with(
    config: Config,
    observation_space: spaces.Space,
    action_space: spaces.Space,
    policy_loss: Callable[[Network, QNetwork, Transition], Array],
    td_target: Callable[[QNetwork, Transition, Array], Array],
    critic_layer_norm: bool = False,
) -> Algorithm:
    """Returns TD3 with a loss of the actor and a TD target of its own; the critics of plain layers may have layer norm.

    Args:
        config: hyperparameters.
        observation_space: as for :func:`make`.
        action_space: as for :func:`make`.
        policy_loss: as :func:`policy_loss`.
        td_target: as :func:`td_target`.
        critic_layer_norm: whether the hidden layers of critics are normalized, whatever those of the actor are.
    """
    action_dim = action_dimension(check_box_action(action_space, config.name))
    inputs = network_inputs(config, observation_space)
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm)
    shape = critic_shape = inputs[1]
    if critic_layer_norm and shape.architecture == "mlp" and shape.torso is None and not shape.has_branches:
        critic_shape = dataclasses.replace(shape, layer_norm=True)
    settings = config.n_critics, QNetwork, action_dim
    make_actor, make_critics = actor_and_critics(inputs, action_dim, *settings, critic_shape=critic_shape)

    def init(key: Array) -> State:
        actor_key, critics_key, update_key = jax.random.split(key, 3)
        actor, critics = make_actor(actor_key), make_critics(critics_key)
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

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        key, rate = nth(state.key, state.n_updates), at(config.learning_rate, clock.progress)
        sigma, limit = config.target_policy_noise, config.target_noise_clip
        next_action = without_gradient(smoothed_action)(state.target_actor, batch.next_obs, key, sigma, limit)
        target = without_gradient(td_target)(state.target_critics, batch, next_action)
        critics, critics_optimizer, loss, values = minimize(
            critics_loss, state.critics, state.critics_optimizer, optimizer, rate, batch, target
        )
        n_updates = state.n_updates + 1

        def delayed(state: State) -> State:
            loss_of_actor, gradients = value_and_grad(policy_loss)(state.actor, critics, batch)
            actor, actor_optimizer = descend(state.actor, gradients, state.actor_optimizer, optimizer, rate)
            return dataclasses.replace(
                state,
                actor=actor,
                actor_optimizer=actor_optimizer,
                actor_loss=loss_of_actor,
                target_actor=polyak(state.target_actor, actor, config.tau),
                target_critics=polyak(state.target_critics, critics, config.tau),
            )

        state = dataclasses.replace(state, critics=critics, critics_optimizer=critics_optimizer, n_updates=n_updates)
        state = jax.lax.cond(n_updates % config.policy_delay == 0, delayed, lambda s: s, state)
        metrics = metrics_of(loss, state.actor_loss, values, jnp.mean(jnp.abs(values - target[None]), axis=0))
        return state, metrics

    algorithm = Algorithm(init, lambda state: state.actor, explore, policy, update, action_values=values_by_critics)
    networks = lambda state: (state.actor, state.critics)  # noqa: E731
    return acting_from_memory(algorithm, networks) if config.has_memory else algorithm


def policy_loss(actor: Network, critics: QNetwork, batch: Transition) -> Array:
    """Returns the loss of the actor by the first of the critics."""
    return actor_loss(actor, first(critics), batch.obs)[0]


def smoothed_action(target_actor: Network, next_obs: PyTree, key: Array, sigma: float, clip: float) -> Array:
    """Returns the target actor's actions with clipped noise, in [-1, 1], ``(batch, action_dim)``."""
    action = policy(target_actor, next_obs)
    noise = jnp.clip(sigma * jax.random.normal(key, action.shape), -clip, clip)
    return jnp.clip(action + noise, -1.0, 1.0)


def td_target(target_critics: QNetwork, batch: Transition, next_action: Array) -> Array:
    """Returns the TD targets, ``(batch,)``."""
    next_value = jnp.min(action_values(target_critics, batch.next_obs, next_action), axis=0)
    return batch.reward + batch.discount * next_value


def critics_loss(critics: QNetwork, batch: Transition, target: Array) -> tuple[Array, Array]:
    """Returns the mean squared TD errors summed over the critics, and the values, ``(n_critics, batch)``."""
    values = action_values(critics, batch.obs, batch.action)
    return jnp.sum(weighted_mean(jnp.square(values - target[None]), batch.weight)), values
