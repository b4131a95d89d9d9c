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

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers, search
from rejeu.algorithms.config import OffPolicyConfig, network_inputs
from rejeu.algorithms.search import SearchSpace
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
    tau_at,
    weighted_mean,
    without_gradient,
)
from rejeu.core.schedules import Schedule, at
from rejeu.core.spaces import action_dimension, check_box_action
from rejeu.core.validation import coerce, whole
from rejeu.networks import Network, QNetwork, Widths

HIDDEN_LAYERS = (400, 300)
"""Default widths of actor and critic but on images, those of the paper."""


@dataclass(frozen=True, kw_only=True)
class DeterministicPolicyConfig(OffPolicyConfig):
    """The hyperparameters that DDPG and TD3 share. Abstract."""

    learning_rate: float | Schedule = 1e-3

    hidden_layers: ClassVar[Widths] = Widths(HIDDEN_LAYERS, HIDDEN_LAYERS)
    hidden_layers_on_images: ClassVar[Widths] = OffPolicyConfig.hidden_layers
    search_space: ClassVar[SearchSpace] = {**search.OFF_POLICY, **search.ACTION_NOISE}


@dataclass(frozen=True, kw_only=True)
class Config(DeterministicPolicyConfig):
    """Hyperparameters of DDPG; the defaults are those of Stable-Baselines3."""

    target_update_interval: int = 1
    """Gradient steps between two updates of both target networks. A larger interval is more stable and slower."""

    name: ClassVar[str] = "DDPG"

    def __post_init__(self) -> None:
        DeterministicPolicyConfig.__post_init__(self)
        coerce(self, "target_update_interval", whole, least=1)


class State(eqx.Module):
    """Everything that DDPG learns; every leaf is an array."""

    actor: Network
    critic: PyTree
    """A :class:`QNetwork`; for Discrete actions a :class:`Network` that gives the values of all actions."""
    target_actor: Network = eqx.field(metadata=AVERAGED)
    target_critic: PyTree = eqx.field(metadata=AVERAGED)
    actor_optimizer: PyTree
    critic_optimizer: PyTree
    n_updates: Array
    """Gradient steps taken, ``int32[]``."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns DDPG for Box actions."""
    action_dim = action_dimension(check_box_action(action_space, config.name))
    values = lambda state, obs, action: action_value(state.critic, obs, action)[None]  # noqa: E731
    parts = make_with(config, observation_space, action_dim, QNetwork, td_target, critic_loss, actor_loss)
    return Algorithm(*parts[:2], explore, policy, parts[2], action_values=values)


def make_with(
    config: Config,
    observation_space: spaces.Space,
    n_outputs: int,
    critic_class: type[PyTree],
    td_target: Callable[[PyTree, PyTree, Transition], Array],
    critic_loss: Callable[[PyTree, Transition, Array], tuple[Array, Array]],
    actor_loss: Callable[[PyTree, PyTree, PyTree], tuple[Array, Metrics]],
) -> tuple[Callable[..., PyTree], Callable[..., PyTree], Callable[..., PyTree]]:
    """Returns ``init``, ``actor`` and ``update`` of DDPG with losses as those of this module.

    The actor has ``n_outputs``, which the critic, a ``critic_class``, takes or gives. With the actor's loss come metrics.
    """
    obs_leaves, shape = network_inputs(config, observation_space)
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm)

    def init(key: Array) -> State:
        actor_key, critic_key = jax.random.split(key)
        actor = Network(actor_key, obs_leaves, n_outputs, shape.actor_widths(), shape)
        critic = critic_class(critic_key, obs_leaves, n_outputs, shape.critic_widths(), shape)
        targets = copy(actor), copy(critic)
        return State(actor, critic, *targets, optimizer.init(actor), optimizer.init(critic), jnp.int32(0))

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        rate, n_updates = at(config.learning_rate, clock.progress), state.n_updates + 1
        target = without_gradient(td_target)(state.target_actor, state.target_critic, batch)
        critic, critic_optimizer, loss, values = minimize(
            critic_loss, state.critic, state.critic_optimizer, optimizer, rate, batch, target
        )
        actor, actor_optimizer, policy_loss, more = minimize(
            actor_loss, state.actor, state.actor_optimizer, optimizer, rate, critic, batch.obs
        )
        tau = tau_at(n_updates, config.tau, config.target_update_interval)
        targets = polyak(state.target_actor, actor, tau), polyak(state.target_critic, critic, tau)
        metrics = metrics_of(loss, policy_loss, values, jnp.abs(values - target)) | more
        return State(actor, critic, *targets, actor_optimizer, critic_optimizer, n_updates), metrics

    return init, lambda state: state.actor, update


def metrics_of(critic_loss: Array, actor_loss: Array, values: Array, td_error: Array) -> Metrics:
    """Returns the metrics of an update."""
    return {"critic_loss": critic_loss, "actor_loss": actor_loss, "q_value": jnp.mean(values), TD_ERROR: td_error}


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


def actor_loss(actor: Network, critic: QNetwork, obs: PyTree) -> tuple[Array, Metrics]:
    """Returns minus the mean value of the actor's own actions, and no metrics."""
    return -jnp.mean(action_value(critic, obs, policy(actor, obs))), {}
