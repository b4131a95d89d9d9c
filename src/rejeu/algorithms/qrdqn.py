"""Quantile regression DQN: the network learns the whole distribution of the return of each action, as quantiles.

Source: Dabney et al. 2018, "Distributional Reinforcement Learning with Quantile Regression" (arXiv 1710.10044). With
``N`` quantiles ``theta_i(s, a)`` at the levels ``tau_i = (i + 1/2) / N``, counted from 0, their old copy ``theta'`` and
discount ``d`` (0 where the MDP terminated, gamma to the power n for n-step returns)::

    Q(s, a)  = 1/N sum_i theta_i(s, a)
    a'       = argmax_a Q'(s', a)
    y_j      = r + d theta'_j(s', a')
    J        = mean sum_i 1/N sum_j |tau_i - 1{u_ij < 0}| h(u_ij),     u_ij = y_j - theta_i(s, a)

``h`` is Huber's function with the threshold 1 (equation 10; QR-DQN-1 in the paper). Target network, exploration and all
else are those of :mod:`rejeu.algorithms.dqn`. Defaults follow Stable-Baselines3's companion package sb3-contrib, which
has Adam's epsilon at 0.01 / batch_size as in the paper, and no limit on the gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from gymnasium import spaces
from jax import Array

from rejeu.algorithms.config import OffPolicyConfig, with_widths
from rejeu.algorithms.dqn import (
    HIDDEN_LAYERS,
    check_discrete_action,
    check_exploration,
    check_steps,
    clipped,
    epsilon_greedy,
    epsilon_schedule,
    greedy,
    moved_target,
    moves_due,
    taken,
)
from rejeu.algorithms.quantile_loss import quantile_huber_loss
from rejeu.core import AVERAGED, TD_ERROR, Algorithm, Clock, Metrics, PyTree, Transition, copy, descend, weighted_mean
from rejeu.networks import Actor, Widths
from rejeu.schedules import Schedule, at
from rejeu.spaces import leaves
from rejeu.validation import whole


@dataclass(frozen=True, kw_only=True)
class Config(OffPolicyConfig):
    """Hyper-parameters of QR-DQN; the defaults are those of sb3-contrib."""

    learning_rate: float | Schedule = 5e-5
    """Step size of Adam; a number, ``rejeu.Linear(start, end)``, ``rejeu.Exponential(start, end)`` or ``"lin_5e-5"``.
    Raising it learns faster until it diverges."""
    batch_size: int = 32
    """Transitions per gradient step. Raising it gives a steadier, dearer step."""
    tau: float = 1.0
    """Share of the network that flows into its target every ``target_update_interval`` steps, in (0, 1]; 1 copies."""
    train_freq: int | tuple[int, Literal["step", "episode"]] = 4
    """Learn every so many environment steps, or ``(n, "episode")``: every n finished episodes. Counted over all
    environments together, whatever their number."""
    n_quantiles: int = 200
    """Quantiles of the return per action. Raising it describes the distribution more finely, at more cost."""
    target_update_interval: int = 10_000
    """Environment steps between two moves of the target network, over all environments. Raising it is steadier and
    slower."""
    exploration_fraction: float = 0.005
    """Share of the run over which epsilon falls, in (0, 1]."""
    exploration_initial_eps: float = 1.0
    """Probability of a random action at the beginning, in [0, 1]."""
    exploration_final_eps: float = 0.01
    """Probability of a random action from ``exploration_fraction`` of the run on, in [0, 1]."""
    exploration_schedule: Literal["linear", "exponential"] = "linear"
    """How epsilon falls: on a straight line, or by the same factor for every equal stretch of the run. The run is
    measured in what ``learn`` was given: steps, episodes or minutes."""
    max_grad_norm: float | None = None
    """Longest gradient, as a Euclidean norm over all parameters; longer ones are scaled down. None: no limit."""

    name: ClassVar[str] = "QRDQN"
    hidden_layers: ClassVar[Widths] = Widths(HIDDEN_LAYERS, HIDDEN_LAYERS)
    hidden_layers_on_images: ClassVar[Widths] = Widths((), ())

    def __post_init__(self) -> None:
        OffPolicyConfig.__post_init__(self)
        check_exploration(self)
        check_steps(self)
        object.__setattr__(self, "n_quantiles", whole("n_quantiles", self.n_quantiles, least=1))


class State(eqx.Module):
    """Everything that QR-DQN learns, every leaf an array."""

    network: QuantileNetwork
    target_network: QuantileNetwork = eqx.field(metadata=AVERAGED)
    optimizer: PyTree
    step: Array
    """Environment steps at the newest gradient step, ``uint32[]``: tells when the target is to move next."""
    n_updates: Array
    """Gradient steps taken, ``int32[]``."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns QR-DQN for these spaces.

    Raises:
        ValueError: if the action space is not Discrete.
        TypeError: if the observation space holds something that is no array.
    """
    n_actions, n_quantiles = check_discrete_action(action_space, "QRDQN"), config.n_quantiles
    obs_leaves = leaves(observation_space)
    shape = with_widths(config, obs_leaves).policy_kwargs
    widths = shape.critic_widths(HIDDEN_LAYERS)
    optimizer = optax.scale_by_adam(eps=0.01 / config.batch_size)
    epsilon = epsilon_schedule(config)

    def init(key: Array) -> State:
        outputs = Actor(key, obs_leaves, n_actions * n_quantiles, widths, shape)
        network = QuantileNetwork(outputs, n_quantiles)
        return State(
            network=network,
            target_network=copy(network),
            optimizer=optimizer.init(network),
            step=jnp.uint32(0),
            n_updates=jnp.int32(0),
        )

    def explore(network: QuantileNetwork, obs: PyTree, key: Array, clock: Clock) -> Array:
        return epsilon_greedy(network(obs), at(epsilon, clock.progress), key)

    def exploit(network: QuantileNetwork, obs: PyTree) -> Array:
        return greedy(network(obs))

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        moves = moves_due(state.step, clock.step, config.target_update_interval)
        target_network = moved_target(state.target_network, state.network, moves, config.tau)
        target = td_target(target_network, batch)
        (loss, current), gradients = jax.value_and_grad(quantile_loss, has_aux=True)(state.network, batch, target)
        gradients = clipped(gradients, None, config.max_grad_norm)
        rate = at(config.learning_rate, clock.progress)
        network, optimizer_state = descend(state.network, gradients, state.optimizer, optimizer, rate)
        state = State(
            network=network,
            target_network=target_network,
            optimizer=optimizer_state,
            step=jnp.asarray(clock.step, jnp.uint32),
            n_updates=state.n_updates + 1,
        )
        metrics = {
            "loss": loss,
            "q_value": jnp.mean(current),
            "exploration_rate": jnp.asarray(at(epsilon, clock.progress), jnp.float32),
            TD_ERROR: jnp.abs(jnp.mean(current, axis=-1) - jnp.mean(target, axis=-1)),
        }
        return state, metrics

    def values(state: State, obs: PyTree, action: Array | None) -> Array:
        return state.network(obs)[None]

    return Algorithm(init, lambda state: state.network, explore, exploit, update, action_values=values)


class QuantileNetwork(eqx.Module):
    """Observation to the quantiles of the return of every action."""

    outputs: Actor
    n_quantiles: int = eqx.field(static=True)

    def quantiles(self, obs: PyTree) -> Array:
        """Maps observations ``(batch, ...)`` to quantiles ``(batch, n_actions, n_quantiles)``, in no order."""
        outputs = self.outputs(obs)
        return outputs.reshape(outputs.shape[0], -1, self.n_quantiles)

    def __call__(self, obs: PyTree) -> Array:
        """Maps observations ``(batch, ...)`` to values ``(batch, n_actions)``, the means of the quantiles."""
        return jnp.mean(self.quantiles(obs), axis=-1)


def td_target(target_network: QuantileNetwork, batch: Transition) -> Array:
    """Returns a sample of what the return may be, under the action of highest mean: ``(batch, n_quantiles)``."""
    following = target_network.quantiles(batch.next_obs)
    best = taken(following, greedy(jnp.mean(following, axis=-1)))
    return batch.reward[:, None] + batch.discount[:, None] * best


def quantile_loss(network: QuantileNetwork, batch: Transition, target: Array) -> tuple[Array, Array]:
    """Returns the mean quantile Huber loss, and the quantiles of the actions taken, ``(batch, n_quantiles)``."""
    current = taken(network.quantiles(batch.obs), batch.action)
    loss = target.shape[-1] * quantile_huber_loss(current, target)
    return weighted_mean(loss, batch.weight), current
