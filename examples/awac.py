"""Advantage-weighted actor-critic (Nair et al. 2020, arXiv 2006.09359), for Box actions.

With policy ``pi``, critics ``Q_i``, target critics ``Q'_i`` and discount ``d`` (0 where the MDP terminated)::

    y     = r + d min_i Q'_i(s', a'),                        a' ~ pi(. | s')
    J_Q   = sum_i mean (Q_i(s, a) - y)^2
    A     = min_i Q_i(s, a) - min_i Q_i(s, b),               b ~ pi(. | s)
    J_pi  = -sum softmax(A / beta) log pi(a | s)             the softmax is over the batch, as in the authors' code
    Q'_i <- Q'_i + tau (Q_i - Q'_i)
"""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

import rejeu
from rejeu.agents.presets import Preset
from rejeu.algorithms import optimizers
from rejeu.algorithms.config import OffPolicyConfig
from rejeu.core.algorithm import AVERAGED, TD_ERROR, PyTree, copy, descend, ensemble, minimize, polyak, weighted_mean
from rejeu.core.distributions import Normal
from rejeu.core.schedules import at
from rejeu.core.spaces import action_dimension, check_box_action, leaves
from rejeu.networks import Network, QNetwork, action_values


@dataclass(frozen=True, kw_only=True)
class Config(OffPolicyConfig):
    """Hyperparameters of AWAC."""

    beta: float = 1.0
    """Temperature of the advantage weights. Lowering it imitates only the best actions of a batch."""
    name: ClassVar[str] = "AWAC"


class Policy(eqx.Module):
    """A normal distribution with a network for its mean, and one learned standard deviation for each action."""

    network: Network
    log_std: Array

    def __call__(self, obs: PyTree) -> Normal:
        return Normal(jnp.tanh(self.network(obs)), jnp.clip(self.log_std, -6.0, 0.0))

    def sample(self, obs: PyTree, key: Array, clock: rejeu.Clock | None = None) -> Array:
        return jnp.clip(self(obs).sample(key), -1.0, 1.0)


class State(eqx.Module):
    """Everything that is learned; every leaf is an array."""

    actor: Policy
    critics: QNetwork
    target_critics: QNetwork = eqx.field(metadata=AVERAGED)
    actor_optimizer: PyTree
    critics_optimizer: PyTree
    key: Array
    n_updates: Array


def make(config: Config, observation_space, action_space) -> rejeu.Algorithm:
    size = action_dimension(check_box_action(action_space, "AWAC"))
    inputs, shape = leaves(observation_space), config.policy_kwargs
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm)  # and limits the norm of gradients

    def init(key: Array) -> State:
        actor_key, q_key, update_key = jax.random.split(key, 3)
        actor = Policy(Network(actor_key, inputs, size, shape.actor_widths((256, 256)), shape), jnp.zeros((1, size)))
        critics = ensemble(lambda k: QNetwork(k, inputs, size, shape.critic_widths((256, 256)), shape), q_key, 2)
        moments = optimizer.init(actor), optimizer.init(critics)
        return State(actor, critics, copy(critics), *moments, update_key, jnp.int32(0))

    def update(state: State, batch: rejeu.Transition, clock: rejeu.Clock):
        target_key, actor_key = jax.random.split(jax.random.fold_in(state.key, state.n_updates))
        rate = at(config.learning_rate, clock.progress)
        target = td_target(state.actor, state.target_critics, batch, target_key)
        critics, critics_optimizer, critic_loss, values = minimize(
            critics_loss, state.critics, state.critics_optimizer, optimizer, rate, batch, target
        )
        loss, gradients = jax.value_and_grad(actor_loss)(state.actor, critics, batch, config.beta, actor_key)
        actor, actor_optimizer = descend(state.actor, gradients, state.actor_optimizer, optimizer, rate)
        td_error = jnp.mean(jnp.abs(values - target[None]), axis=0)
        metrics = {"critic_loss": critic_loss, "actor_loss": loss, "q_value": jnp.mean(values), TD_ERROR: td_error}
        learned = actor, critics, polyak(state.target_critics, critics, config.tau), actor_optimizer, critics_optimizer
        return State(*learned, state.key, state.n_updates + 1), metrics

    return rejeu.Algorithm(init, lambda state: state.actor, Policy.sample, lambda actor, obs: actor(obs).mode(), update)


def td_target(actor: Policy, target_critics: QNetwork, batch: rejeu.Transition, key: Array) -> Array:
    values = action_values(target_critics, batch.next_obs, actor.sample(batch.next_obs, key))
    return batch.reward + batch.discount * jnp.min(values, axis=0)


def critics_loss(critics: QNetwork, batch: rejeu.Transition, target: Array) -> tuple[Array, Array]:
    values = action_values(critics, batch.obs, batch.action)
    return jnp.sum(weighted_mean(jnp.square(values - target[None]), batch.weight)), values


def actor_loss(actor: Policy, critics: QNetwork, batch: rejeu.Transition, beta: float, key: Array) -> Array:
    value = jnp.min(action_values(critics, batch.obs, actor.sample(batch.obs, key)), axis=0)
    advantage = jnp.min(action_values(critics, batch.obs, batch.action), axis=0) - value
    weight = jax.lax.stop_gradient(jax.nn.softmax(advantage / beta))
    return -jnp.sum(weight * actor(batch.obs).log_prob(batch.action))


class AWAC(rejeu.OffPolicyAgent):
    """Advantage-weighted actor-critic, for Box actions."""

    algorithm: ClassVar = SimpleNamespace(Config=Config, make=make)


settings = dict(n_envs=2, total_steps=20_000, evaluate_every=2_000, evaluate_episodes=10)
pendulum = Preset(env_id="Pendulum-v1", algorithm="AWAC", hyperparameters={"beta": 2.0}, source="example", **settings)
rejeu.register(AWAC, presets=[pendulum])
