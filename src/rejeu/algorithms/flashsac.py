"""FlashSAC: SAC with few updates of large batches through normalized, projected networks and categorical critics.

Source: Kim et al. 2026, "FlashSAC" (github.com/Holiday-Robot/FlashSAC, whose code this follows where the two differ). With
policy ``pi``, critics that give distributions ``Z_i`` of the return over 101 values, their targets ``Z'_i``, temperature
``alpha`` and discount ``d`` (0 where the MDP terminated)::

    a'                          ~ pi(. | s')
    [Z'_i(s, a), Z'_i(s', a')]  = one training pass of both halves through Z'_i, and likewise through Z_i
    k                           = argmin_i E Z'_i(s', a')
    m                           = projection of r + d (Z'_k(s', a') - alpha log pi(a' | s'))     (categorical)
    J_Z                         = sum_i mean cross-entropy(m, Z_i(s, a))
    J_pi                        = mean (alpha log pi(a | s) - min_i E Z_i(s, a)),       a ~ pi(. | s), reparameterized
    Z'_i                       <- Z'_i + tau (Z_i - Z'_i)

Rewards are divided so that returns fit the values of the critics: by the standard deviation of the returns, but at least by
the largest return in size over ``value_limit`` (:mod:`rejeu.core.normalization`). The networks are inverted residual blocks
with batch normalization, and after each step weights and gains are scaled to a fixed norm (:mod:`rejeu.networks.projected`). A
network goes by the statistics of the batch, which for the critics has both halves and for the actor the observations of both,
only in its own loss. The actor and the temperature, whose loss is SAC's, take a step at every ``policy_delay``-th update. The
target entropy is that of a normal distribution with the standard deviation 0.15, and exploring noise is held
(:mod:`rejeu.exploration.held_noise`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers, search
from rejeu.algorithms.categorical import cross_entropy, make_atoms, mean_of, project
from rejeu.algorithms.crossq import check_shape
from rejeu.algorithms.sac.continuous import (
    EntropyConfig,
    State,
    after_actor,
    after_critics,
    every,
    initial_alpha,
    metrics_of,
)
from rejeu.algorithms.search import Choice, Integers, SearchSpace
from rejeu.core.algorithm import (
    Algorithm,
    Clock,
    Metrics,
    Optimizer,
    PyTree,
    Transition,
    copy,
    ensemble,
    minimize,
    weighted_mean,
    without_gradient,
)
from rejeu.core.distributions import TanhNormal
from rejeu.core.normalization import NormalizationConfig
from rejeu.core.prng import nth
from rejeu.core.schedules import Linear, Schedule, at
from rejeu.core.spaces import Leaf, action_dimension, check_box_action, leaves
from rejeu.core.validation import LARGEST_VALUE, MOST_OUTPUTS, coerce, number, whole
from rejeu.exploration.held_noise import held_explorer
from rejeu.networks import PolicyConfig, Widths
from rejeu.networks.batch_renorm import RenormalizedNetwork, with_statistics
from rejeu.networks.projected import InvertedResidual, head, projected

ACTOR_LAYERS = (128, 128)
"""Default widths of the actor's blocks."""
CRITIC_LAYERS = (256, 256)
"""Default widths of each critic's blocks."""
LOG_STD_RANGE = (-10.0, 2.0)
"""Bounds of the policy's log standard deviation, in nats."""


@dataclass(frozen=True, kw_only=True)
class Config(EntropyConfig):
    """Hyperparameters of FlashSAC; the defaults are those of the authors for MuJoCo."""

    learning_rate: float | Schedule = Linear(3e-4, 1.5e-4)
    batch_size: int = 512
    tau: float = 0.01
    learning_starts: int = 10_000
    ent_coef: float | str = "auto_0.01"
    target_entropy: float | str = "std_0.15"
    noise_repeat: int = 16
    normalize: NormalizationConfig | None = NormalizationConfig(norm_obs=False, max_return=5.0)
    n_bins: int = 101
    """Values over which the critics predict the distribution of the return. A larger number describes it more finely."""
    value_limit: float = 5.0
    """Largest value of a critic, and minus the smallest. Scaled returns must fit: it is ``max_return`` of ``normalize``."""
    policy_delay: int = 2
    """Gradient steps of the critics per step of actor and temperature. A larger number computes less."""

    name: ClassVar[str] = "FlashSAC"
    target_update_interval: ClassVar[int] = 1
    entropy_per_action: ClassVar[float] = -1.0
    """Share of a target entropy of ``"auto"`` that each action dimension has, in nats."""
    reads_both: ClassVar[bool] = True
    """Whether the actor normalizes by the observations of both halves; not so in XQC."""
    search_space: ClassVar[SearchSpace] = {
        **search.OFF_POLICY,
        "policy_kwargs.net_arch": Choice(([32, 32], [64, 64], [128, 128])),
        "policy_delay": Integers(1, 4),
    }
    hidden_layers: ClassVar[Widths] = Widths(ACTOR_LAYERS, CRITIC_LAYERS)
    hidden_layers_on_images: ClassVar[Widths] = hidden_layers

    def __post_init__(self) -> None:
        EntropyConfig.__post_init__(self)
        coerce(self, "policy_delay", whole, least=1)
        coerce(self, "n_bins", whole, least=2, most=MOST_OUTPUTS)
        coerce(self, "value_limit", number, above=0, most=LARGEST_VALUE)
        check_shape(self.policy_kwargs, self.name)
        self.check_widths()

    def check_widths(self) -> None:
        """Raises ``ValueError`` unless the blocks of a network have one width."""
        shape = self.policy_kwargs
        for widths in (shape.actor_widths(ACTOR_LAYERS), shape.critic_widths(CRITIC_LAYERS)):
            if len(set(widths)) != 1:
                raise ValueError(
                    f"{self.name} has blocks of one width throughout: net_arch={list(widths)} must hold equal numbers, one a "
                    "block, such as [64, 64]"
                )

    def torso(self, key: Array, n_inputs: int, widths: tuple[int, ...]) -> Any:
        """Returns hidden layers."""
        return InvertedResidual(key, n_inputs, widths, self.policy_kwargs.activation_fn)

    def log_std(self, outputs: Array) -> Array:
        """Returns log standard deviations within :data:`LOG_STD_RANGE` from outputs of the actor."""
        low, high = LOG_STD_RANGE
        return low + 0.5 * (high - low) * (1.0 + jnp.tanh(outputs))


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns FlashSAC for these spaces; its state is SAC's.

    Raises:
        ValueError: if the action space is not a finite Box.
        TypeError: if the observation space holds something that is not an array.
    """
    action_dim = action_dimension(check_box_action(action_space, config.name))
    obs_leaves, values = leaves(observation_space), make_atoms(-config.value_limit, config.value_limit, config.n_bins)
    target_entropy = config.entropy_target(config.entropy_per_action * action_dim, action_dim)
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm)

    def policy(outputs: Array) -> TanhNormal:
        mean, log_std = jnp.split(outputs, 2, axis=-1)
        return TanhNormal(mean, config.log_std(log_std))

    def init(key: Array) -> State:
        return initial_state(key, obs_leaves, action_dim, config, optimizer)

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        target_key, actor_key = jax.random.split(nth(state.key, state.n_updates))
        rate, alpha = at(config.learning_rate, clock.progress), jnp.exp(state.log_alpha)
        next_action, next_log_prob = policy(state.actor(batch.next_obs)).sample_and_log_prob(target_key)
        obs = joined(batch.obs, batch.next_obs)
        pairs = obs, joined(batch.action, next_action)
        target = without_gradient(td_target)(state.target_critics, *pairs, batch, alpha * next_log_prob, values)
        critics, critics_optimizer, critic_loss, (logits, trained) = minimize(
            critics_loss, state.critics, state.critics_optimizer, optimizer, rate, *pairs, target, batch.weight
        )
        critics = projected(with_statistics(critics, trained))
        state = after_critics(state, critics, critics_optimizer, config)

        def improve(state: State) -> tuple[State, Array, Array]:
            seen = obs if config.reads_both else batch.obs
            judged = critics, alpha, batch.obs, seen, actor_key, values, policy
            actor, actor_optimizer, loss, (log_prob, trained) = minimize(
                actor_loss, state.actor, state.actor_optimizer, optimizer, rate, *judged
            )
            actor = projected(with_statistics(actor, trained))
            state = after_actor(state, actor, actor_optimizer, log_prob, target_entropy, config, rate)
            return state, loss, -jnp.mean(log_prob)

        state, policy_loss, entropy = every(config.policy_delay, state, improve)
        predicted, wanted = mean_of(logits, values), target @ values
        return state, metrics_of(critic_loss, policy_loss, alpha, entropy, predicted, wanted, target_entropy, config)

    def explore(actor: RenormalizedNetwork, obs: PyTree, key: Array, clock: Clock) -> Array:
        return policy(actor(obs)).sample(key)

    explorer = None
    if config.noise_repeat > 1:
        explorer = held_explorer(lambda actor, obs: policy(actor(obs)), action_dim, config.noise_repeat)
    return Algorithm(
        init,
        lambda state: state.actor,
        explore,
        lambda actor, obs: policy(actor(obs)).mode(),
        update,
        explorer,
        action_values=lambda state, obs, action: action_values(state.critics, obs, action, values),
    )


def initial_state(
    key: Array, obs_leaves: tuple[Leaf, ...], action_dim: int, config: Config, optimizer: Optimizer
) -> State:
    """Returns the state before the first update."""
    actor_key, critics_key, update_key = jax.random.split(key, 3)
    shape: PolicyConfig = config.policy_kwargs

    def network(key: Array, n_actions: int | None, n_outputs: int, widths: tuple[int, ...]) -> RenormalizedNetwork:
        torso: Callable[[Array, int], Any] = lambda key, n_inputs: config.torso(key, n_inputs, widths)  # noqa: E731
        return RenormalizedNetwork(key, obs_leaves, n_actions, n_outputs, torso, head)

    widths = shape.critic_widths(config.hidden_layers.critics)
    actor = network(actor_key, None, 2 * action_dim, shape.actor_widths(config.hidden_layers.actor))
    critics = ensemble(lambda k: network(k, action_dim, config.n_bins, widths), critics_key, config.n_critics)
    log_alpha, alpha_optimizer = initial_alpha(config)
    return State(
        actor=actor,
        critics=critics,
        target_critics=copy(critics),
        log_alpha=log_alpha,
        actor_optimizer=optimizer.init(actor),
        critics_optimizer=optimizer.init(critics),
        alpha_optimizer=alpha_optimizer,
        key=update_key,
        n_updates=jnp.int32(0),
        actor_loss=None if config.policy_delay == 1 else jnp.float32(0.0),
        entropy=None if config.policy_delay == 1 else jnp.float32(0.0),
    )


def joined(now: PyTree, then: PyTree) -> PyTree:
    """Returns two batches as one of twice the size."""
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b], axis=0), now, then)


def trained_logits(critics: Any, obs: PyTree, action: Array) -> tuple[Array, Any]:
    """Returns the logits of each critic in training, ``(n_critics, batch, n_bins)``, and critics that have seen the batch."""
    return jax.vmap(lambda critic: critic.train(obs, action))(critics)


def action_values(critics: Any, obs: PyTree, action: Array, values: Array) -> Array:
    """Returns the mean of each critic's distribution by the running statistics, ``(n_critics, batch)``."""
    return mean_of(jax.vmap(lambda critic: critic(obs, action))(critics), values)


def td_target(
    target_critics: Any, obs: PyTree, action: Array, batch: Transition, next_entropy_cost: Array, values: Array
) -> Array:
    """Returns the distributions that the critics should predict, ``(batch, n_bins)``.

    Args:
        target_critics: stacked; of each pair the one with the least mean counts.
        obs: those of the batch and, after them, the next ones.
        action: likewise, with those that the policy takes next.
        batch: gives rewards and discounts.
        next_entropy_cost: ``alpha log pi(a' | s')``, ``(batch,)``.
        values: of the bins.
    """
    logits = jnp.split(trained_logits(target_critics, obs, action)[0], 2, axis=1)[1]
    least = jnp.argmin(mean_of(logits, values), axis=0)
    chosen = jnp.take_along_axis(logits, least[None, :, None], axis=0)[0]
    atoms = batch.reward[:, None] + batch.discount[:, None] * (values[None] - next_entropy_cost[:, None])
    return project(atoms, jax.nn.softmax(chosen), values)


def critics_loss(
    critics: Any, obs: PyTree, action: Array, target: Array, weight: Array | None
) -> tuple[Array, tuple[Array, Any]]:
    """Returns the cross-entropy of the first half, averaged over the batch and summed over critics.

    With it come the logits of the first half ``(n_critics, batch, n_bins)`` and the critics that have seen the batch.
    """
    logits, trained = trained_logits(critics, obs, action)
    logits = jnp.split(logits, 2, axis=1)[0]
    return jnp.sum(weighted_mean(cross_entropy(logits, target), weight)), (logits, trained)


def actor_loss(
    actor: RenormalizedNetwork,
    critics: Any,
    alpha: Array,
    obs: PyTree,
    seen: PyTree,
    key: Array,
    values: Array,
    policy: Callable[[Array], TanhNormal],
) -> tuple[Array, tuple[Array, RenormalizedNetwork]]:
    """Returns the soft policy loss at ``obs``, the critics judging by their running statistics.

    The actor normalizes by ``seen``, which begins with ``obs``. With the loss come the log-probabilities of the actions drawn,
    ``(batch,)``, and the actor that has seen the batch.
    """
    outputs, trained = actor.train(seen)
    action, log_prob = policy(outputs[: len(jax.tree.leaves(obs)[0])]).sample_and_log_prob(key)
    value = jnp.min(action_values(critics, obs, action, values), axis=0)
    return jnp.mean(alpha * log_prob - value), (log_prob, trained)
