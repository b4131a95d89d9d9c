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
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import search
from rejeu.algorithms.quantile_loss import quantile_huber_loss
from rejeu.algorithms.sac.continuous import Config as SACConfig, SdeActor, make_with, policy
from rejeu.algorithms.search import Integers, SearchSpace
from rejeu.core.algorithm import Algorithm, PyTree, Transition, weighted_mean
from rejeu.core.validation import coerce, whole
from rejeu.networks import Network, QNetwork, each


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
        coerce(self, "n_quantiles", whole, least=1)
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
    n_pooled = config.target_subset or config.n_critics
    n_kept = n_pooled * (config.n_quantiles - config.top_quantiles_to_drop_per_net)
    target = partial(td_target, n_kept=n_kept)
    settings = config, observation_space, action_space
    return make_with(*settings, target, critics_loss, mean_values, judge, config.n_quantiles, measure)


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


def mean_values(critics: QNetwork, obs: PyTree, action: Array) -> Array:
    """Returns the mean of each critic's quantiles, ``(n_critics, batch)``."""
    return jnp.mean(action_quantiles(critics, obs, action), axis=-1)


def td_target(
    actor: Network | SdeActor, target_critics: QNetwork, alpha: Array, batch: Transition, key: Array, n_kept: int
) -> Array:
    """Returns samples of the return that the critics should predict, ``(batch, n_kept)``."""
    next_action, next_log_prob = policy(actor, batch.next_obs).sample_and_log_prob(key)
    smallest_quantiles = truncate(action_quantiles(target_critics, batch.next_obs, next_action), n_kept)
    return batch.reward[:, None] + batch.discount[:, None] * (smallest_quantiles - (alpha * next_log_prob)[:, None])


def critics_loss(critics: QNetwork, batch: Transition, target: Array) -> tuple[Array, Array]:
    """Returns the quantile Huber loss, averaged over the batch and summed over critics, and the critics' quantiles."""
    quantiles = action_quantiles(critics, batch.obs, batch.action)
    return jnp.sum(weighted_mean(quantile_huber_loss(quantiles, target), batch.weight)), quantiles


def measure(quantiles: Array, target: Array) -> tuple[Array, Array]:
    """Returns the means of the critics' quantiles, and how far they are from those of the targets, ``(n_critics, batch)``."""
    values = jnp.mean(quantiles, axis=-1)
    return values, values - jnp.mean(target, axis=-1)[None]


def judge(critics: QNetwork, obs: PyTree, action: Array) -> Array:
    """Returns the value of an action that the actor climbs, ``(batch,)``: the mean of all quantiles, none left out."""
    return jnp.mean(action_quantiles(critics, obs, action), axis=(0, 2))
