"""TD3 with a behavior cloning term: learns from recorded actions and stays close to them.

Source: Fujimoto & Gu 2021, "A Minimalist Approach to Offline Reinforcement Learning" (arXiv 2106.06860). Everything is as in
:mod:`rejeu.algorithms.td3` but the loss of the actor ``mu``, for recorded actions ``a`` of ``n`` components::

    scale  = alpha / mean |Q_1(s, mu(s))|,    of which no gradient is taken
    J_mu   = -scale mean Q_1(s, mu(s)) + mean |mu(s) - a|^2 / n                                equations 5 and 6

As in the authors' code the scale has the values of the actor's actions, where the paper has those of recorded ones, and
observations are normalized by the statistics of the data set. It is meant for :func:`rejeu.demonstrations.learn_offline` and
``offline=True``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import search, td3
from rejeu.algorithms.ddpg.continuous import action_value, policy
from rejeu.core.algorithm import Algorithm, Transition
from rejeu.core.normalization import NormalizationConfig
from rejeu.core.schedules import Schedule
from rejeu.core.validation import coerce, number
from rejeu.networks import Network, QNetwork, Widths, first


@dataclass(frozen=True, kw_only=True)
class Config(td3.Config):
    """Hyperparameters of TD3+BC; the defaults are those of the paper."""

    learning_rate: float | Schedule = 3e-4
    normalize: NormalizationConfig | None = NormalizationConfig(norm_obs=True, norm_reward=False)
    alpha: float = 2.5
    """Weight of the values against recorded actions. 0 is behavior cloning; a larger one strays further from them."""

    can_remember: ClassVar[bool] = False
    hidden_layers: ClassVar[Widths] = Widths((256, 256), (256, 256))
    name: ClassVar[str] = "TD3BC"
    search_space: ClassVar[search.SearchSpace] = {**search.OFFLINE, "alpha": search.LogUniform(0.3, 30.0)}

    def __post_init__(self) -> None:
        td3.Config.__post_init__(self)
        coerce(self, "alpha", number, least=0)

    def doubts(self, n_envs: int) -> str:
        """Returns a warning if how far actions may go from those in the data was left to the default."""
        if self.alpha != type(self).alpha:
            return ""
        return (
            "how far TD3+BC may go from the recorded actions depends on the data, and alpha=2.5 may learn nothing from "
            "few good episodes among many random ones; try 0.3 to 30 (rejeu tune does), or IQL, and evaluate"
        )


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns TD3+BC for these spaces; raises as :func:`rejeu.algorithms.td3.make` does."""
    loss = partial(policy_loss, alpha=config.alpha)
    return td3.make_with(config, observation_space, action_space, loss, td3.td_target)


def policy_loss(actor: Network, critics: QNetwork, batch: Transition, alpha: float) -> Array:
    """Returns the loss of the actor."""
    action = policy(actor, batch.obs)
    values = action_value(first(critics), batch.obs, action)
    scale = alpha / jax.lax.stop_gradient(jnp.mean(jnp.abs(values)))
    return -scale * jnp.mean(values) + jnp.mean(jnp.square(action - batch.action))
