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

import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms.sac.continuous import Config, algorithm_of, check_discrete, networks, squared_error
from rejeu.algorithms.soft import SoftCritic
from rejeu.core.algorithm import Algorithm, Clock, PyTree, Transition, some_allowed, unmasked
from rejeu.core.distributions import Categorical, forbid
from rejeu.core.types import AnyArray
from rejeu.networks import Network, each

TARGET_ENTROPY_SHARE = 0.3
"""Automatic target entropy as a share of the uniform policy's."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Discrete) -> Algorithm:
    """Returns SAC for Discrete actions.

    Raises:
        ValueError: with gSDE.
    """
    check_discrete(config)
    n_actions = int(action_space.n)

    def policy_loss(actor: PyTree, critics: PyTree, alpha: Array, batch: Transition, key: Array) -> tuple[Array, Array]:
        judged = config.judged_by(all_values(critics, batch.obs), axis=0)
        return actor_loss(actor, judged, alpha, batch.obs)

    parts = SoftCritic(
        *networks(config, observation_space, n_actions, Network, n_actions),
        target=lambda actor, target_critics, alpha, batch, key: td_target(actor, target_critics, alpha, batch),
        critics_loss=lambda critics, batch, target, key: critics_loss(critics, batch, target),
        actor_loss=policy_loss,
        target_entropy=lambda obs: config.entropy_target(TARGET_ENTROPY_SHARE * mean_log_count(obs, n_actions)),
        keys=lambda key: (key, jax.random.fold_in(key, 3)),
    )
    values = lambda state, obs, action: all_values(state.critics, obs)  # noqa: E731
    return algorithm_of(parts, config, explore, exploit, {"action_values": values, "imitation": imitation})


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


def mean_log_count(obs: PyTree, n_actions: int) -> AnyArray:
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


def critics_loss(critics: PyTree, batch: Transition, target: Array) -> tuple[Array, tuple[Array, Array]]:
    """Returns half the squared TD error summed over critics; the values of the actions and the TD errors."""
    return squared_error(taken(all_values(critics, batch.obs), batch.action), target, batch)


def taken(values: Array, action: Array) -> Array:
    """Returns the values of actions ``(batch,)`` among those of all, ``(n_critics, batch)``."""
    index = jnp.broadcast_to(action[None, :, None], (*values.shape[:-1], 1))
    return jnp.take_along_axis(values, index, axis=-1)[..., 0]


def actor_loss(actor: Network, values: Array, alpha: Array, obs: PyTree) -> tuple[Array, Array]:
    """Returns the soft policy loss, and the mean log-probabilities, which are minus the entropies in nats, ``(batch,)``.

    ``values`` is ``(batch, n_actions)``.
    """
    log_probabilities = jax.nn.log_softmax(logits(actor, obs))
    probabilities = jnp.exp(log_probabilities)
    loss = jnp.mean(jnp.sum(probabilities * (alpha * log_probabilities - values), axis=-1))
    return loss, jnp.sum(probabilities * log_probabilities, axis=-1)
