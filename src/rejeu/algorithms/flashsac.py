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

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers, search
from rejeu.algorithms.categorical import cross_entropy, make_atoms, mean_of, project
from rejeu.algorithms.crossq import Equations, check_shape, joined, joint_outputs, make_with
from rejeu.algorithms.search import Choice, Integers, SearchSpace
from rejeu.algorithms.soft import EntropyConfig
from rejeu.core.algorithm import Algorithm, PyTree, Transition, weighted_mean
from rejeu.core.normalization import NormalizationConfig
from rejeu.core.schedules import Linear, Schedule
from rejeu.core.validation import LARGEST_VALUE, coerce, number, whole
from rejeu.networks import Widths
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
        coerce(self, "n_bins", whole, least=2)
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

    def torso(self, key: Array, n_inputs: int, widths: tuple[int, ...]) -> PyTree:
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
    atoms = make_atoms(-config.value_limit, config.value_limit, config.n_bins)
    equations = Equations(
        target=partial(td_target, atoms=atoms),
        critics_loss=critics_loss,
        values=partial(action_values, atoms=atoms),
        measure=partial(measure, atoms=atoms),
        n_outputs=config.n_bins,
        head=head,
        log_std=config.log_std,
        after_step=projected,
        seen=lambda batch: joined(batch.obs, batch.next_obs) if config.reads_both else batch.obs,
    )
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm)
    return make_with(config, observation_space, action_space, equations, optimizer)


def action_values(critics: PyTree, obs: PyTree, action: Array, atoms: Array) -> Array:
    """Returns the mean of each critic's distribution by the running statistics, ``(n_critics, batch)``."""
    return mean_of(jax.vmap(lambda critic: critic(obs, action))(critics), atoms)


def td_target(
    target_critics: PyTree, batch: Transition, next_action: Array, next_entropy_cost: Array, atoms: Array
) -> Array:
    """Returns the distributions that the critics should predict, ``(batch, n_bins)``.

    Args:
        target_critics: stacked; of each pair the one with the least mean counts.
        batch: of transitions.
        next_action: that the policy takes at ``batch.next_obs``.
        next_entropy_cost: ``alpha log pi(a' | s')``, ``(batch,)``.
        atoms: the values of the bins.
    """
    _, logits, _ = joint_outputs(target_critics, batch, next_action)
    least = jnp.argmin(mean_of(logits, atoms), axis=0)
    least_logits = jnp.take_along_axis(logits, least[None, :, None], axis=0)[0]
    following = batch.reward[:, None] + batch.discount[:, None] * (atoms[None] - next_entropy_cost[:, None])
    return project(following, jax.nn.softmax(least_logits), atoms)


def critics_loss(
    critics: PyTree, batch: Transition, next_action: Array, target: Array
) -> tuple[Array, tuple[Array, PyTree]]:
    """Returns the cross-entropy of ``target`` and the predictions, averaged over the batch and summed over critics.

    With it come the predicted logits ``(n_critics, batch, n_bins)`` and the critics that have seen the batch.
    """
    logits, _, trained = joint_outputs(critics, batch, next_action)
    return jnp.sum(weighted_mean(cross_entropy(logits, target), batch.weight)), (logits, trained)


def measure(logits: Array, target: tuple[Array, Array], atoms: Array) -> tuple[Array, Array]:
    """Returns the values that logits and the second part of ``target`` mean: the former and their errors."""
    values = mean_of(logits, atoms)
    return values, values - (target[1] @ atoms)[None]
