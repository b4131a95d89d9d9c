"""Parallelized Q-network: Q-learning from rollouts, without replay buffer and without target network.

Source: Gallici et al. 2024, "Simplifying Deep Temporal Difference Learning" (arXiv 2407.04811, algorithm 1). Layer norm in
the network ``Q`` keeps the values from diverging, and many environments take the place of the replay buffer. With the
reward ``r_t``, the true successor ``s'_t``, the discount ``d_t`` (0 where the MDP terminated) and ``lambda``, computed
backwards over the rollout with the network that collected it::

    V'_t = max_a Q(s'_t, a)
    R_t  = r_t + d_t [(1 - lambda) V'_t + lambda R_{t+1}],      lambda is 0 where an episode or the rollout ends
    J    = mean (Q(s, a) - R)^2 / 2                             over minibatches, for several epochs
    a    = argmax_a Q(s, a), or any with probability epsilon

So a time limit bootstraps from the state in which it was reached, where the authors' code treats it as a terminal state. The
returns are not cut at random actions: Q(lambda) of Peng and Williams 1994, "Incremental Multi-Step Q-Learning". Unlike
there, epsilon changes with every step rather than with every rollout, and a last, smaller minibatch is padded and the
padding is not counted.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers, search
from rejeu.algorithms.actor_critic.gae import summed_backwards
from rejeu.algorithms.actor_critic.steps import RolloutState as State, flat, initial_state, masked_mean, minibatches
from rejeu.algorithms.config import network_inputs
from rejeu.algorithms.dqn import check_epsilon, epsilon_greedy_algorithm, epsilon_schedule, metrics_of, taken
from rejeu.algorithms.rollout_config import RolloutConfig
from rejeu.algorithms.search import SearchSpace
from rejeu.core.algorithm import GRADIENT_STEPS, Algorithm, Clock, Metrics, PyTree, Rollout, minimize
from rejeu.core.prng import nth
from rejeu.core.schedules import Linear, Schedule, at
from rejeu.core.spaces import check_discrete_action
from rejeu.core.validation import assign, coerce, number, whole
from rejeu.networks import Network, PolicyConfig, Widths

HIDDEN_LAYERS = (128, 128)
"""Default widths of the network but on images, those of the authors' code."""
FEW = 8
"""Number of environments up to which the defaults are meant."""
FOR_MANY = {
    "learning_rate": 2.5e-4,
    "n_steps": 32,
    "batch_size": 128,
    "n_epochs": 2,
    "q_lambda": 0.65,
    "exploration_fraction": 0.1,
    "exploration_final_eps": 0.001,
}
"""Hyperparameters for many environments, those of the authors for Atari with 128. With 1 to 8 environments they learn nothing
on ordinary runs: epsilon falls before there is anything to exploit, and gradient steps are few."""


@dataclass(frozen=True)
class NormalizedConfig(PolicyConfig):
    """The shape of the network, whose layers are normalized unless otherwise asked for."""

    layer_norm: bool | None = None  # type: ignore[assignment]
    """Normalize each hidden layer before its nonlinearity. None does so wherever it can be chosen: SimBa and a torso of
    your own have a normalization of their own or none."""
    cnn_layer_norm: bool = True
    """Normalize the layers of the CNN of an image likewise, each pixel over its channels."""

    def __post_init__(self) -> None:
        if self.layer_norm is None:
            assign(self, layer_norm=self.torso is None and self.architecture == "mlp")
        PolicyConfig.__post_init__(self)


@dataclass(frozen=True, kw_only=True)
class Config(RolloutConfig):
    """Hyperparameters of PQN; the defaults are for 1 to 8 environments, :data:`FOR_MANY` for about 128."""

    learning_rate: float | Schedule = Linear(1e-3, 0.0)
    """Step size of the optimizer. It falls to 0: with a constant one the last weights may be bad ones, since no target network
    slows down the changes of the policy."""
    n_steps: int = 128
    """Steps of each environment between two updates. A larger number bootstraps later and updates less often."""
    batch_size: int = 32
    """Steps per gradient step. Larger batches reduce the variance of the gradient at a higher cost."""
    n_epochs: int = 4
    """Passes over every rollout. More learn more from it, with targets that are further behind."""
    q_lambda: float = 0.9
    """Lambda of Q(lambda), in [0, 1]: 0 bootstraps after one step, 1 sums all rewards to the end of the episode or the
    rollout. A larger value has less bias and more variance, and follows random actions for longer."""
    exploration_fraction: float = 0.5
    """Fraction of the run over which epsilon decreases, in (0, 1]."""
    exploration_initial_eps: float = 1.0
    """Initial probability of a random action, in [0, 1]."""
    exploration_final_eps: float = 0.05
    """Probability of a random action from ``exploration_fraction`` of the run on, in [0, 1]."""
    exploration_schedule: Literal["linear", "exponential"] = "linear"
    """How epsilon decreases: linearly, or by the same factor for equal parts of the run. The run is measured in what
    ``learn`` was given: steps, episodes or minutes."""
    max_grad_norm: float | None = 10.0
    optimizer: Any = "radam"
    """As for the other algorithms, such as ``"adam"`` or ``optax.lamb``; the authors use rectified Adam."""
    policy_kwargs: NormalizedConfig = dataclasses.field(default_factory=NormalizedConfig)
    """Shape of the network: ``net_arch``, ``activation_fn``, ``layer_norm`` and ``cnn_layer_norm`` (both on),
    ``architecture``, branches (``state_layers``, ``common_layers``, ``critic_layers``), or modules of your own as
    ``encoder``, ``torso`` and ``head``."""

    name: ClassVar[str] = "PQN"
    policy_kwargs_class: ClassVar[type[PolicyConfig]] = NormalizedConfig
    hidden_layers: ClassVar[Widths] = Widths(HIDDEN_LAYERS, HIDDEN_LAYERS)
    search_space: ClassVar[SearchSpace] = search.PQN
    for_many: ClassVar[Mapping[str, Any]] = FOR_MANY

    def __post_init__(self) -> None:
        RolloutConfig.__post_init__(self)
        coerce(self, ("batch_size", "n_epochs"), whole, least=1)
        coerce(self, "q_lambda", number, least=0, most=1)
        check_epsilon(self)

    def doubts(self, n_envs: int) -> str:
        """Returns a warning if these are the defaults with many environments, or the values for many with few."""
        if n_envs <= FEW and all(getattr(self, key) == value for key, value in FOR_MANY.items()):
            return (
                f"these hyperparameters of PQN are for about 128 environments, and there are {n_envs}; use the defaults"
            )
        defaults = all(getattr(self, key) == getattr(type(self), key) for key in FOR_MANY)
        if n_envs > FEW and defaults:
            return (
                f"PQN's defaults are for 1 to {FEW} environments, and there are {n_envs}; for about 128 use "
                "rejeu.PQN(..., **rejeu.algorithms.pqn.FOR_MANY), else set learning_rate, batch_size and n_epochs"
            )
        return ""

    def steps_per_gradient(self, n_envs: int) -> int:
        """Returns the number of steps of ``n_envs`` environments per gradient step."""
        return min(self.batch_size, self.n_steps * n_envs)

    def gradient_steps(self, n: int) -> int:
        """Returns the number of gradient steps on a rollout of ``n`` steps."""
        return self.n_epochs * -(-n // self.batch_size)


class StepTargets(NamedTuple):
    """The steps of a rollout as the loss takes them, leaves ``(batch, ...)``."""

    obs: PyTree
    action: Array
    target: Array
    """The lambda-return ``R``."""
    valid: Array
    """Whether the step exists, ``bool``."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns PQN for these spaces.

    Raises:
        ValueError: if the action space is not Discrete.
        TypeError: if the observation space holds something that is not an array.
    """
    n_actions = check_discrete_action(action_space, config.name)
    obs_leaves, shape = network_inputs(config, observation_space)
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm)
    epsilon = epsilon_schedule(config)

    def init(key: Array) -> State:
        build = lambda key: Network(key, obs_leaves, n_actions, shape.critic_widths(), shape)  # noqa: E731
        return initial_state(key, build, optimizer)

    def update(state: State, rollout: Rollout, clock: Clock) -> tuple[State, Metrics]:
        data = samples(state.network, rollout, config.q_lambda)
        order_key = nth(state.key, state.n_rollouts)
        minibatch, n_steps = minibatches(data, order_key, config.n_epochs, config.batch_size)
        rate = at(config.learning_rate, clock.progress)

        def step(i: Array, learned: tuple[Network, PyTree, Array]) -> tuple[Network, PyTree, Array]:
            network, optimizer_state, sums = learned
            batch = minibatch(i)
            network, optimizer_state, loss, q_value = minimize(
                td_loss, network, optimizer_state, optimizer, rate, batch
            )
            return network, optimizer_state, sums + jnp.stack([loss, q_value])

        begin = (state.network, state.optimizer, jnp.zeros(2, jnp.float32))
        network, optimizer_state, sums = jax.lax.fori_loop(0, n_steps, step, begin)
        loss, q_value = sums / jnp.maximum(n_steps, 1).astype(jnp.float32)
        metrics = metrics_of(loss, q_value, epsilon, clock) | {
            GRADIENT_STEPS: n_steps.astype(jnp.float32),
            "learning_rate": jnp.asarray(rate, jnp.float32),
        }
        return state.after(network, optimizer_state, n_steps), metrics

    def value(carry: PyTree, network: Network, obs: PyTree, ended: Array) -> Array:
        return jnp.max(network(obs), axis=-1)

    return epsilon_greedy_algorithm(init, update, epsilon, state_value=value)


def samples(network: Network, rollout: Rollout, q_lambda: float) -> StepTargets:
    """Returns the steps of a rollout along one axis, with their targets by the network that collected it."""
    next_value = jnp.max(network(flat(rollout.next_obs)), axis=-1).reshape(rollout.reward.shape)
    last = jnp.concatenate([~rollout.valid[1:], jnp.ones_like(rollout.valid[:1])])
    target = lambda_returns(rollout.reward, next_value, rollout.discount, rollout.ended | last, q_lambda)
    return flat(StepTargets(rollout.obs, rollout.action, target, rollout.valid))


def lambda_returns(reward: Array, next_value: Array, discount: Array, ended: Array, q_lambda: float) -> Array:
    """Returns the targets ``R``, ``(steps, n_envs)``.

    Args:
        reward: ``(steps, n_envs)``, like all other arrays.
        next_value: highest value in the true successor, also where an episode ended.
        discount: gamma, and 0 where the MDP terminated.
        ended: where an episode or the rollout ended.
        q_lambda: in [0, 1]. With 1 the return is the discounted sum of rewards to that end, plus the value there unless the
            MDP terminated; with 0 it is the TD target of one step.

    >>> steps = lambda *values: jnp.array(values)[:, None]
    >>> ended = steps(False, False, True)
    >>> lambda_returns(steps(1.0, 2.0, 4.0), steps(0.0, 0.0, 8.0), steps(0.5, 0.5, 0.5), ended, 1.0)[:, 0]
    Array([4., 6., 8.], dtype=float32)
    """
    mixing = jnp.where(ended, 0.0, q_lambda)
    return summed_backwards(reward + discount * (1.0 - mixing) * next_value, discount * mixing)


def td_loss(network: Network, batch: StepTargets) -> tuple[Array, Array]:
    """Returns half the mean square of the TD errors ``Q(s, a) - R``, and the mean of ``Q(s, a)``."""
    value = taken(network(batch.obs), batch.action)
    return masked_mean(0.5 * jnp.square(value - batch.target), batch.valid), masked_mean(value, batch.valid)
