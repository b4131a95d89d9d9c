"""Quantile regression DQN: the network learns the whole distribution of the return of each action, as quantiles.

Source: Dabney et al. 2018, "Distributional Reinforcement Learning with Quantile Regression" (arXiv 1710.10044). With
``N`` quantiles ``theta_i(s, a)`` at the levels ``tau_i = (i + 1/2) / N``, counted from 0, target quantiles ``theta'`` and
discount ``d`` (0 where the MDP terminated, gamma to the power n for n-step returns)::

    Q(s, a)  = 1/N sum_i theta_i(s, a)
    a'       = argmax_a Q'(s', a)
    y_j      = r + d theta'_j(s', a')
    J        = mean sum_i 1/N sum_j |tau_i - 1{u_ij < 0}| h(u_ij),     u_ij = y_j - theta_i(s, a)

``h`` is Huber's function with the threshold 1 (equation 10; QR-DQN-1 in the paper). Target network, exploration and
everything else are those of :mod:`rejeu.algorithms.dqn`. Defaults follow Stable-Baselines3's companion package sb3-contrib,
which has Adam's epsilon at 0.01 / batch_size as in the paper, and no limit on the gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers
from rejeu.algorithms.config import network_inputs
from rejeu.algorithms.dqn import (
    HIDDEN_LAYERS,
    QLearningConfig,
    State,
    epsilon_greedy_algorithm,
    greedy,
    initial_state,
    metrics_of,
    moved_target,
    moves_due,
    taken,
)
from rejeu.algorithms.quantile_loss import quantile_huber_loss
from rejeu.core import (
    TD_ERROR,
    Algorithm,
    Clock,
    Metrics,
    PyTree,
    Transition,
    descend,
    some_allowed,
    unmasked,
    weighted_mean,
)
from rejeu.networks import Network
from rejeu.schedules import Schedule, at
from rejeu.spaces import check_discrete_action
from rejeu.validation import coerce, whole


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
    """Returns QR-DQN for these spaces; its state is DQN's, with :class:`QuantileNetwork`.

    Raises:
        ValueError: if the action space is not Discrete.
        TypeError: if the observation space holds something that is not an array.
    """
    n_actions, n_quantiles = check_discrete_action(action_space, config.name), config.n_quantiles
    obs_leaves, shape = network_inputs(config, observation_space)
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm, eps=0.01 / config.batch_size)
    epsilon = config.epsilon

    def init(key: Array) -> State:
        outputs = Network(key, obs_leaves, n_actions * n_quantiles, shape.critic_widths(HIDDEN_LAYERS), shape)
        return initial_state(QuantileNetwork(outputs, n_quantiles), optimizer)

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        moves = moves_due(state.step, clock.step, config.target_update_interval)
        target_network = moved_target(state.target_network, state.network, moves, config.tau)
        target = td_target(target_network, batch)
        (loss, current), gradients = jax.value_and_grad(quantile_loss, has_aux=True)(state.network, batch, target)
        rate = at(config.learning_rate, clock.progress)
        network, optimizer_state = descend(state.network, gradients, state.optimizer, optimizer, rate)
        step = jnp.asarray(clock.step, jnp.uint32)
        metrics = metrics_of(loss, jnp.mean(current), epsilon, clock)
        metrics[TD_ERROR] = jnp.abs(jnp.mean(current, axis=-1) - jnp.mean(target, axis=-1))
        return State(network, target_network, optimizer_state, step, state.n_updates + 1), metrics

    return epsilon_greedy_algorithm(init, update, epsilon)


class QuantileNetwork(eqx.Module):
    """Observation to the quantiles of the return of every action."""

    outputs: Network
    n_quantiles: int = eqx.field(static=True)

    def quantiles(self, obs: PyTree) -> Array:
        """Maps observations ``(batch, ...)`` to quantiles ``(batch, n_actions, n_quantiles)``, unordered."""
        outputs = self.outputs(obs)
        return outputs.reshape(outputs.shape[0], -1, self.n_quantiles)

    def __call__(self, obs: PyTree) -> Array:
        """Maps observations ``(batch, ...)`` to values ``(batch, n_actions)``, the means of the quantiles."""
        return jnp.mean(self.quantiles(obs), axis=-1)


def td_target(target_network: QuantileNetwork, batch: Transition) -> Array:
    """Returns a sample of what the return may be, under the action of highest mean: ``(batch, n_quantiles)``."""
    following = target_network.quantiles(batch.next_obs)
    best = taken(following, greedy(jnp.mean(following, axis=-1), unmasked(some_allowed(batch.next_obs))[1]))
    return batch.reward[:, None] + batch.discount[:, None] * best


def quantile_loss(network: QuantileNetwork, batch: Transition, target: Array) -> tuple[Array, Array]:
    """Returns the mean quantile Huber loss, and the quantiles of the actions taken, ``(batch, n_quantiles)``."""
    current = taken(network.quantiles(batch.obs), batch.action)
    loss = target.shape[-1] * quantile_huber_loss(current, target)
    return weighted_mean(loss, batch.weight), current
