"""Truncated quantile critics: SAC whose critics learn the distribution of the return and whose targets drop its upper tail.

Source: Kuznetsov et al. 2020, "Controlling Overestimation Bias with Truncated Mixture of Continuous Distributional
Quantile Critics" (arXiv 2005.04269). Each of N critics gives M quantiles ``z_n(s, a)`` of the return; the target
critics give ``z'_n``. With policy ``pi``, temperature ``alpha`` and discount ``d`` (0 where the MDP terminated)::

    z_(1) <= z_(2) <= ...   = all N M quantiles z'_n(s', a') together, in order,      a' ~ pi(. | s')
    y_i         = r + d (z_(i) - alpha log pi(a' | s')),                              i = 1 .. N (M - dropped)
    J_Z         = sum_n mean rho(y_i - z_n(s, a)),                                    the quantile Huber loss
    J_pi        = mean (alpha log pi(a | s) - mean of all quantiles z_n(s, a)),       a ~ pi(. | s), reparameterized

Policy, temperature, targets and the order of the steps are SAC's (:mod:`rejeu.algorithms.sac`); with ``target_subset`` the
quantiles of so many critics are pooled. As there, the critics' losses are summed, which gives each the gradient of its own;
Stable-Baselines3 Contrib takes their mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers, search
from rejeu.algorithms.memory import remembering
from rejeu.algorithms.quantile_loss import quantile_huber_loss
from rejeu.algorithms.sac.continuous import (
    HIDDEN_LAYERS,
    Config as SACConfig,
    SdeActor,
    State,
    after_actor,
    after_critics,
    every,
    exploit,
    explore,
    explorer_of,
    initial_state,
    metrics_of,
    networks,
    policy,
)
from rejeu.algorithms.search import Integers, SearchSpace
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
from rejeu.core.prng import nth
from rejeu.core.schedules import at
from rejeu.core.spaces import Leaf, action_dimension, check_box_action, leaves
from rejeu.core.validation import MOST_OUTPUTS, coerce, whole
from rejeu.networks import Network, QNetwork, each, with_dropout


@dataclass(frozen=True, kw_only=True)
class Config(SACConfig):
    """Hyperparameters of TQC: those of SAC, and of the quantiles. The defaults are those of Stable-Baselines3 Contrib."""

    n_quantiles: int = 25
    """Quantiles that each critic predicts. A larger number describes the return more finely at a higher cost."""
    top_quantiles_to_drop_per_net: int = 2
    """Number of the largest quantiles per critic that the target drops. A larger number is more pessimistic."""

    name: ClassVar[str] = "TQC"
    search_space: ClassVar[SearchSpace] = {**search.OFF_POLICY, "top_quantiles_to_drop_per_net": Integers(0, 5)}

    def __post_init__(self) -> None:
        SACConfig.__post_init__(self)
        coerce(self, "n_quantiles", whole, least=1, most=MOST_OUTPUTS)
        coerce(self, "top_quantiles_to_drop_per_net", whole, least=0)
        if self.top_quantiles_to_drop_per_net >= self.n_quantiles:
            raise ValueError(
                f"top_quantiles_to_drop_per_net={self.top_quantiles_to_drop_per_net} would leave nothing of "
                f"n_quantiles={self.n_quantiles}; use at most {self.n_quantiles - 1}"
            )


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns TQC for these spaces; its state is SAC's, with critics of ``n_quantiles`` outputs.

    Raises:
        ValueError: if the action space is not a finite Box.
        TypeError: if the observation space holds something that is not an array.
    """
    action_dim = action_dimension(check_box_action(action_space, config.name))
    obs_leaves, shape = leaves(observation_space), config.policy_kwargs
    target_entropy = config.entropy_target(-float(action_dim), action_dim)
    n_pooled = config.target_subset or config.n_critics
    n_kept = n_pooled * (config.n_quantiles - config.top_quantiles_to_drop_per_net)
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm)

    def critic(key: Array, leaves: tuple[Leaf, ...], shape: Any) -> QNetwork:
        widths = shape.critic_widths(HIDDEN_LAYERS)
        return QNetwork(key, leaves, action_dim, widths, shape, config.n_quantiles)

    def init(key: Array) -> State:
        return initial_state(key, obs_leaves, 2 * action_dim, critic, config, optimizer)

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        target_key, actor_key = jax.random.split(nth(state.key, state.n_updates))
        rate, alpha = at(config.learning_rate, clock.progress), jnp.exp(state.log_alpha)
        target_critics = config.for_target(state.target_critics, target_key)
        target = without_gradient(td_target)(state.actor, target_critics, alpha, batch, target_key, n_kept)
        drop, judge_drop = config.dropout_keys(actor_key)
        critics, critics_optimizer, critic_loss, quantiles = minimize(
            critics_loss, state.critics, state.critics_optimizer, optimizer, rate, batch, target, drop
        )
        state = after_critics(state, critics, critics_optimizer, config)

        def improve(state: State) -> tuple[State, Array, Array]:
            judges = with_dropout(critics, judge_drop), alpha, batch.obs, actor_key
            actor, actor_optimizer, loss, log_prob = minimize(
                actor_loss, state.actor, state.actor_optimizer, optimizer, rate, *judges
            )
            state = after_actor(state, actor, actor_optimizer, log_prob, target_entropy, config, rate)
            return state, loss, -jnp.mean(log_prob)

        state, policy_loss, entropy = every(config.policy_delay, state, improve)
        values, expected = jnp.mean(quantiles, axis=-1), jnp.mean(target, axis=-1)
        return state, metrics_of(critic_loss, policy_loss, alpha, entropy, values, expected, target_entropy, config)

    values = lambda state, obs, action: jnp.mean(action_quantiles(state.critics, obs, action), axis=-1)  # noqa: E731
    actor = lambda state: state.actor  # noqa: E731
    algorithm = Algorithm(init, actor, explore, exploit, update, explorer_of(config, action_dim), action_values=values)
    return remembering(algorithm, shape, networks)


def action_quantiles(critics: QNetwork, obs: PyTree, action: Array) -> Array:
    """Returns the quantiles that each of the stacked critics gives, ``(n_critics, batch, n_quantiles)``, unordered."""
    return each(critics, obs, lambda critic, obs: critic(obs, action))


def truncate(quantiles: Array, n_kept: int) -> Array:
    """Returns the ``n_kept`` smallest of all critics' quantiles, ascending, ``(batch, n_kept)``.

    >>> truncate(jnp.array([[[3.0, 1.0]], [[2.0, 9.0]]]), 3).tolist()
    [[1.0, 2.0, 3.0]]
    """
    pooled = jnp.swapaxes(quantiles, 0, 1).reshape(quantiles.shape[1], -1)
    return -jax.lax.top_k(-pooled, n_kept)[0]


def td_target(
    actor: Network | SdeActor, target_critics: QNetwork, alpha: Array, batch: Transition, key: Array, n_kept: int
) -> Array:
    """Returns samples of the return that the critics should predict, ``(batch, n_kept)``."""
    next_action, next_log_prob = policy(actor, batch.next_obs).sample_and_log_prob(key)
    kept = truncate(action_quantiles(target_critics, batch.next_obs, next_action), n_kept)
    return batch.reward[:, None] + batch.discount[:, None] * (kept - (alpha * next_log_prob)[:, None])


def critics_loss(critics: QNetwork, batch: Transition, target: Array, drop: Array | None = None) -> tuple[Array, Array]:
    """Returns the quantile Huber loss, averaged over the batch and summed over critics, and the critics' quantiles.

    ``drop`` is the key of the critics' dropout, None for none.
    """
    quantiles = action_quantiles(with_dropout(critics, drop), batch.obs, batch.action)
    return jnp.sum(weighted_mean(quantile_huber_loss(quantiles, target), batch.weight)), quantiles


def actor_loss(
    actor: Network | SdeActor, critics: QNetwork, alpha: Array, obs: PyTree, key: Array
) -> tuple[Array, Array]:
    """Returns the soft policy loss and the log-probabilities of the actions drawn, ``(batch,)``.

    The value of an action is the mean of all quantiles, none left out.
    """
    action, log_prob = policy(actor, obs).sample_and_log_prob(key)
    value = jnp.mean(action_quantiles(critics, obs, action), axis=(0, 2))
    return jnp.mean(alpha * log_prob - value), log_prob
