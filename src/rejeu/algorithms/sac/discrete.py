"""Soft actor-critic for Discrete actions: expectations over actions are sums, so no action is sampled.

Source: Christodoulou 2019, "Soft Actor-Critic for Discrete Action Settings" (arXiv 1910.07207). With policy ``pi(a | s)``,
critics ``Q_i(s)`` with one value per action, target critics ``Q'_i``, temperature ``alpha`` and discount ``d``::

    V(s')    = sum_a pi(a | s') (min_i Q'_i(s', a) - alpha log pi(a | s'))
    J_Q      = sum_i mean (Q_i(s)[a] - (r + d V(s')))^2 / 2
    J_pi     = mean sum_a pi(a | s) (alpha log pi(a | s) - min_i Q_i(s, a))
    J_alpha  = mean log_alpha (H(pi(. | s)) - target_entropy)

With action masks, ``pi`` is 0 for forbidden actions, and n below is the number of allowed ones in each state.
``target_entropy="auto"`` is 0.3 log n. With the paper's 0.98 log n the policy stays nearly uniform and, with few actions,
never becomes good.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers
from rejeu.algorithms.memory import remembering
from rejeu.algorithms.sac.continuous import (
    HIDDEN_LAYERS,
    Config,
    State,
    after_actor,
    after_critics,
    check_discrete,
    every,
    initial_state,
    metrics_of,
    networks,
)
from rejeu.core.algorithm import (
    Algorithm,
    Clock,
    Metrics,
    PyTree,
    Transition,
    minimize,
    some_allowed,
    unmasked,
    weighted_mean,
    without_gradient,
)
from rejeu.core.distributions import Categorical, forbid
from rejeu.core.prng import nth
from rejeu.core.schedules import at
from rejeu.core.spaces import Leaf, leaves
from rejeu.networks import Network, each, with_dropout

TARGET_ENTROPY_SHARE = 0.3
"""Automatic target entropy as a share of the uniform policy's."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Discrete) -> Algorithm:
    """Returns SAC for Discrete actions.

    Raises:
        ValueError: with gSDE.
    """
    check_discrete(config)
    obs_leaves, n_actions, shape = leaves(observation_space), int(action_space.n), config.policy_kwargs
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm)

    def critic(key: Array, leaves: tuple[Leaf, ...], shape: Any) -> Network:
        return Network(key, leaves, n_actions, shape.critic_widths(HIDDEN_LAYERS), shape)

    def init(key: Array) -> State:
        return initial_state(key, obs_leaves, n_actions, critic, config, optimizer)

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        rate, alpha = at(config.learning_rate, clock.progress), jnp.exp(state.log_alpha)
        target_entropy: Any = config.entropy_target(TARGET_ENTROPY_SHARE * mean_log_count(batch.obs, n_actions))
        key = nth(state.key, state.n_updates)
        target = without_gradient(td_target)(state.actor, config.for_target(state.target_critics, key), alpha, batch)
        drop, judge_drop = config.dropout_keys(jax.random.fold_in(key, 3))
        critics, critics_optimizer, critic_loss, values = minimize(
            critics_loss, state.critics, state.critics_optimizer, optimizer, rate, batch, target, drop
        )
        state = after_critics(state, critics, critics_optimizer, config)

        def improve(state: State) -> tuple[State, Array, Array]:
            judged = config.judged_by(all_values(with_dropout(critics, judge_drop), batch.obs), axis=0)
            actor, actor_optimizer, loss, entropy = minimize(
                actor_loss, state.actor, state.actor_optimizer, optimizer, rate, judged, alpha, batch.obs
            )
            state = after_actor(state, actor, actor_optimizer, -entropy, target_entropy, config, rate)
            return state, loss, jnp.mean(entropy)

        state, policy_loss, entropy = every(config.policy_delay, state, improve)
        return state, metrics_of(critic_loss, policy_loss, alpha, entropy, values, target, target_entropy, config)

    values = lambda state, obs, action: all_values(state.critics, obs)  # noqa: E731
    algorithm = Algorithm(
        init, lambda state: state.actor, explore, exploit, update, action_values=values, imitation=imitation
    )
    return remembering(algorithm, shape, networks)


def explore(actor: Network, obs: PyTree, key: Array, clock: Clock) -> Array:
    """Returns actions sampled from the policy, ``int32 (batch,)``."""
    return jax.random.categorical(key, logits(actor, obs)).astype(jnp.int32)


def exploit(actor: Network, obs: PyTree) -> Array:
    """Returns the most likely actions, ``int32 (batch,)``."""
    return jnp.argmax(logits(actor, obs), axis=-1).astype(jnp.int32)


def imitation(actor: Network, obs: PyTree, action: Array) -> Array:
    """Returns minus the log-probabilities of actions, ``(batch,)``."""
    return -Categorical(logits(actor, obs)).log_prob(action)


def logits(actor: Network, obs: PyTree) -> Array:
    """Returns the logits of all actions, ``(batch, n_actions)``."""
    return forbid(actor(obs), unmasked(obs)[1])


def mean_log_count(obs: PyTree, n_actions: int) -> Any:
    """Returns the mean entropy in nats of choosing uniformly: ``log(n_actions)``, or that of the allowed ones."""
    mask = unmasked(some_allowed(obs))[1]
    return math.log(n_actions) if mask is None else jnp.mean(jnp.log(jnp.sum(mask, axis=-1, dtype=jnp.float32)))


def all_values(critics: PyTree, obs: PyTree) -> Array:
    """Returns every critic's value of every action, ``(n_critics, batch, n_actions)``."""
    return each(critics, obs, lambda critic, obs: critic(obs))


def td_target(actor: Network, target_critics: PyTree, alpha: Array, batch: Transition) -> Array:
    """Returns the TD targets, ``(batch,)``."""
    log_probabilities = jax.nn.log_softmax(logits(actor, some_allowed(batch.next_obs)))
    soft_values = jnp.min(all_values(target_critics, batch.next_obs), axis=0) - alpha * log_probabilities
    return batch.reward + batch.discount * jnp.sum(jnp.exp(log_probabilities) * soft_values, axis=-1)


def critics_loss(critics: PyTree, batch: Transition, target: Array, drop: Array | None = None) -> tuple[Array, Array]:
    """Returns half the squared TD error summed over critics, and the values of the actions, ``(n_critics, batch)``."""
    values = all_values(with_dropout(critics, drop), batch.obs)
    index = jnp.broadcast_to(batch.action[None, :, None], (*values.shape[:-1], 1))
    values = jnp.take_along_axis(values, index, axis=-1)[..., 0]
    return 0.5 * jnp.sum(weighted_mean(jnp.square(values - target[None]), batch.weight)), values


def actor_loss(actor: Network, values: Array, alpha: Array, obs: PyTree) -> tuple[Array, Array]:
    """Returns the soft policy loss and the entropies in nats, ``(batch,)``; ``values`` is ``(batch, n_actions)``."""
    log_probabilities = jax.nn.log_softmax(logits(actor, obs))
    probabilities = jnp.exp(log_probabilities)
    loss = jnp.mean(jnp.sum(probabilities * (alpha * log_probabilities - values), axis=-1))
    return loss, -jnp.sum(probabilities * log_probabilities, axis=-1)
