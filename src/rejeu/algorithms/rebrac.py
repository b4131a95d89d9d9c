"""ReBRAC: TD3 whose actor and whose targets are both held to recorded actions, each by a weight of its own.

Source: Tarasov et al. 2023, "Revisiting the Minimalist Approach to Offline Reinforcement Learning" (arXiv 2305.09836).
Everything is as in :mod:`rejeu.algorithms.td3` but, with recorded actions ``a`` and ``a_next``, of the step after, and the
smoothed action ``a'`` of the target actor::

    y      = r + d (min_i Q'_i(s', a') - critic_bc |a' - a_next|^2)                            equation 4
    scale  = 1 / mean |min_i Q_i(s, mu(s))|,    of which no gradient is taken
    J_mu   = mean (actor_bc |mu(s) - a|^2 - scale min_i Q_i(s, mu(s)))                         equation 3

Without a recorded next action, after the last step of an episode, there is no penalty. The critics have layer norm, here
before each ReLU and in the authors' code after it, and batches are large. It is meant for
:func:`rejeu.demonstrations.learn_offline` and ``offline=True``.
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
from rejeu.algorithms.ddpg.continuous import policy
from rejeu.core.algorithm import Algorithm, Transition
from rejeu.core.validation import coerce, flag, number
from rejeu.networks import Network, QNetwork, Widths, action_values


@dataclass(frozen=True, kw_only=True)
class Config(td3.Config):
    """Hyperparameters of ReBRAC; the weights are in the middle of the ranges that the paper searched."""

    batch_size: int = 1024
    actor_bc: float = 0.01
    """Weight of the squared distance of the actor's actions from recorded ones. 0.001 where these are poor, 0.1 or more where
    they are few and good."""
    critic_bc: float = 0.01
    """As ``actor_bc``, but of the next actions in the TD targets. 0 trusts the values of actions that were not recorded."""
    critic_layer_norm: bool = True
    """Normalize the hidden layers of critics, if these are plain layers."""

    can_remember: ClassVar[bool] = False
    needs_next_action: ClassVar[bool] = True
    hidden_layers: ClassVar[Widths] = Widths((256, 256, 256), (256, 256, 256))
    name: ClassVar[str] = "ReBRAC"
    search_space: ClassVar[search.SearchSpace] = {
        **search.OFFLINE,
        "batch_size": search.Choice((256, 512, 1024)),
        "actor_bc": search.LogUniform(0.001, 0.3),
        "critic_bc": search.LogUniform(0.001, 0.5),
    }

    def __post_init__(self) -> None:
        td3.Config.__post_init__(self)
        coerce(self, ("actor_bc", "critic_bc"), number, least=0)
        coerce(self, "critic_layer_norm", flag)

    def doubts(self, n_envs: int) -> str:
        """Returns a warning if how far actions may go from those in the data was left to the default."""
        if self.actor_bc != type(self).actor_bc:
            return ""
        return (
            "how far ReBRAC may go from the recorded actions depends on the data, and actor_bc=0.01 may learn nothing from "
            "few good episodes among many random ones; try 0.001 to 0.3 (rejeu tune does), or IQL, and evaluate"
        )


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns ReBRAC for these spaces; raises as :func:`rejeu.algorithms.td3.make` does."""
    loss, target = partial(policy_loss, weight=config.actor_bc), partial(td_target, weight=config.critic_bc)
    return td3.make_with(config, observation_space, action_space, loss, target, config.critic_layer_norm)


def policy_loss(actor: Network, critics: QNetwork, batch: Transition, weight: float) -> Array:
    """Returns the loss of the actor."""
    action = policy(actor, batch.obs)
    values = jnp.min(action_values(critics, batch.obs, action), axis=0)
    scale = 1.0 / jax.lax.stop_gradient(jnp.mean(jnp.abs(values)))
    distance = jnp.sum(jnp.square(action - batch.action), axis=-1)
    return jnp.mean(weight * distance - scale * values)


def td_target(target_critics: QNetwork, batch: Transition, next_action: Array, weight: float) -> Array:
    """Returns the TD targets, ``(batch,)``; ``batch.next_action`` is NaN where none was recorded."""
    recorded = batch.next_action
    distance = jnp.square(next_action - jnp.where(jnp.isnan(recorded), next_action, recorded))
    penalty = weight * jnp.sum(distance, axis=-1)
    return td3.td_target(target_critics, batch, next_action) - batch.discount * penalty
