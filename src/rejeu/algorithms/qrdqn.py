"""Quantile regression DQN: the network learns the whole distribution of the return of each action, as quantiles.

Source: Dabney et al. 2018, "Distributional Reinforcement Learning with Quantile Regression" (arXiv 1710.10044). With
``N`` quantiles ``theta_i(s, a)`` at the levels ``tau_i = (i + 1/2) / N``, counted from 0, target quantiles ``theta'`` and
discount ``d`` (0 where the MDP terminated, gamma to the power n for n-step returns)::

    Q(s, a)  = 1/N sum_i theta_i(s, a)
    a'       = argmax_a Q'(s', a)
    y_j      = r + d theta'_j(s', a')
    J        = mean sum_i 1/N sum_j |tau_i - 1{u_ij < 0}| h(u_ij),     u_ij = y_j - theta_i(s, a)

``h`` is Huber's function with the threshold 1 (equation 10; QR-DQN-1 in the paper). Target network, exploration and
everything else, such as double Q-learning and dueling, are those of :mod:`rejeu.algorithms.dqn`. Defaults follow
Stable-Baselines3's companion package sb3-contrib,
which has Adam's epsilon at 0.01 / batch_size as in the paper, and no limit on the gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers
from rejeu.algorithms.dqn import QLearningConfig, Returns, q_learning, taken, value_network
from rejeu.algorithms.quantile_loss import quantile_huber_loss
from rejeu.core.algorithm import Algorithm, PyTree
from rejeu.core.schedules import Schedule
from rejeu.core.validation import coerce, whole


@dataclass(frozen=True, kw_only=True)
class Config(QLearningConfig):
    """Hyperparameters of QR-DQN; the defaults are those of sb3-contrib."""

    learning_rate: float | Schedule = 5e-5
    n_quantiles: int = 200
    """Quantiles of the return per action. A larger number describes the distribution more finely, at a higher cost."""
    exploration_fraction: float = 0.005
    exploration_final_eps: float = 0.01
    max_grad_norm: float | None = None

    name: ClassVar[str] = "QRDQN"

    def __post_init__(self) -> None:
        QLearningConfig.__post_init__(self)
        coerce(self, "n_quantiles", whole, least=1)


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns QR-DQN for these spaces; its state is DQN's.

    Raises:
        ValueError: if the action space is not Discrete.
        TypeError: if the observation space holds something that is not an array.
    """
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm, eps=0.01 / config.batch_size)
    return q_learning(config, observation_space, action_space, quantile_returns(config.n_quantiles), optimizer)


def quantile_returns(n_quantiles: int) -> Returns:
    """Returns the prediction of so many quantiles of the return. Priorities go by the difference of the two means."""

    def loss(
        network: PyTree, obs: PyTree, action: Array, target: Array, key: Array | None
    ) -> tuple[Array, Array, Array]:
        return quantile_loss(taken(network(obs), action), target)

    return Returns(
        build=partial(value_network, n=n_quantiles),
        values=lambda network, obs, key: jnp.mean(network(obs), axis=-1),
        describe=lambda network, obs, key: network(obs),
        target=quantile_target,
        loss=loss,
    )


def quantile_target(reward: Array, discount: Array, following: Array) -> Array:
    """Returns samples of what the return may be, ``(batch, n)``, from quantiles of the return that follows."""
    return reward[:, None] + discount[:, None] * following


def quantile_loss(current: Array, target: Array, fractions: Array | None = None) -> tuple[Array, Array, Array]:
    """Returns the quantile Huber loss, the difference of the means and the mean, of predicted quantiles, ``(batch,)`` each."""
    loss = current.shape[-1] * quantile_huber_loss(current, target, fractions=fractions)
    value = jnp.mean(current, axis=-1)
    return loss, value - jnp.mean(target, axis=-1), value
