"""The temperature of the entropy bonus, which SAC, TQC and CrossQ share.

Source: Haarnoja et al. 2018, "Soft Actor-Critic Algorithms and Applications" (arXiv 1812.05905, section 5). The
temperature ``alpha`` is fixed or learned::

    J_alpha  = -mean log_alpha (log pi(a | s) + target_entropy)

As in Stable-Baselines3 the loss is written in ``log alpha`` rather than ``alpha``. It is always minimized by Adam.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from rejeu.algorithms import optimizers
from rejeu.algorithms.config import OffPolicyConfig
from rejeu.core import TD_ERROR, Metrics, PyTree, descend
from rejeu.validation import coerce, number, whole

OPTIMIZER = optimizers.make("adam")
"""Of the temperature."""


@dataclass(frozen=True, kw_only=True)
class EntropyConfig(OffPolicyConfig):
    """The hyperparameters of algorithms with an entropy bonus and several critics. Abstract."""

    ent_coef: float | str = "auto"
    """Temperature of the entropy bonus: ``"auto"`` learns it from 1, ``"auto_0.1"`` from 0.1, a number fixes it. A larger
    value explores more."""
    target_entropy: float | str = "auto"
    """Target entropy in nats for learning the temperature. ``"auto"`` is minus the number of action dimensions; for n
    Discrete actions 0.3 log n (the paper's 0.98 log n keeps the policy nearly uniform)."""
    n_critics: int = 2
    """Number of critics."""

    def __post_init__(self) -> None:
        OffPolicyConfig.__post_init__(self)
        initial_temperature(self.ent_coef)
        coerce(self, "target_entropy", lambda key, value: value if value == "auto" else number(key, value))
        coerce(self, "n_critics", whole, least=1)

    def entropy_target(self, automatic: float) -> float:
        """Returns the target entropy in nats, ``automatic`` for ``"auto"``."""
        return automatic if self.target_entropy == "auto" else float(self.target_entropy)

    @property
    def learns_temperature(self) -> bool:
        """Whether the temperature is learned."""
        return isinstance(self.ent_coef, str)


def initial_temperature(ent_coef: float | str) -> float:
    """Returns the initial temperature: 1 for ``"auto"``, x for ``"auto_x"`` and for x.

    Raises:
        ValueError: for anything else.
    """
    if isinstance(ent_coef, str):
        rest = ent_coef.removeprefix("auto").removeprefix("_")
        try:
            value = float(rest) if rest else 1.0
        except ValueError:
            value = -1.0
        if ent_coef.startswith("auto") and 0 < value < math.inf:
            return value
    elif not isinstance(ent_coef, bool) and isinstance(ent_coef, int | float) and 0 < ent_coef < math.inf:
        return float(ent_coef)
    raise ValueError(f"ent_coef={ent_coef!r} must be 'auto', 'auto_0.1' or a positive number")


def initial(config: EntropyConfig) -> tuple[Array, PyTree]:
    """Returns the initial logarithm of the temperature, and the state of its optimizer."""
    log_alpha = jnp.log(jnp.float32(initial_temperature(config.ent_coef)))
    return log_alpha, OPTIMIZER.init(log_alpha)


def temperature_loss(log_alpha: Array, log_prob: Array, target_entropy: float) -> Array:
    """Returns the loss that raises the temperature while the policy's entropy is below its target."""
    return -jnp.mean(log_alpha * (jax.lax.stop_gradient(log_prob) + target_entropy))


def temperature_step(
    log_alpha: Array, optimizer_state: PyTree, log_prob: Array, target_entropy: float, config: EntropyConfig, rate: Any
) -> tuple[Array, PyTree]:
    """Returns the temperature's logarithm and optimizer state after one step, unchanged if the temperature is fixed."""
    if not config.learns_temperature:
        return log_alpha, optimizer_state
    gradient = jax.grad(temperature_loss)(log_alpha, log_prob, target_entropy)
    return descend(log_alpha, gradient, optimizer_state, OPTIMIZER, rate)


def metrics_of(
    critic_loss: Array,
    actor_loss: Array,
    alpha: Array,
    entropy: Array,
    values: Array,
    target: Array,
    target_entropy: float,
    config: EntropyConfig,
) -> Metrics:
    """Returns the metrics of an update, from the values ``(n_critics, batch)`` and their targets ``(batch,)``."""
    loss = {"ent_coef_loss": jnp.log(alpha) * (entropy - target_entropy)} if config.learns_temperature else {}
    return loss | {
        "critic_loss": critic_loss,
        "actor_loss": actor_loss,
        "ent_coef": alpha,
        "entropy": entropy,
        "q_value": jnp.mean(values),
        TD_ERROR: jnp.mean(jnp.abs(values - target[None]), axis=0),
    }
