"""XQC: SAC with batch normalization, projected weights and categorical critics, whose loss is well conditioned.

Source: Palenicek et al. 2026, "XQC: Well-conditioned Optimization Accelerates Deep Reinforcement Learning" (arXiv 2509.25174).
The equations are those of :mod:`rejeu.algorithms.flashsac`, from which it differs by its networks (plain layers, each a linear
map, batch normalization and ReLU), by what is projected (the weights, not the gains), by the actor, whose log standard
deviation is clipped and which normalizes by the batch's observations alone, and by the settings: rewards are divided by the
standard deviation of the returns alone, the target entropy is minus half the number of action dimensions, and noise is not
held. Unlike in the authors' code, the actor's learning rate falls with that of the critics, not with its own, fewer steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
from jax import Array

from rejeu.algorithms import flashsac
from rejeu.algorithms.flashsac import LOG_STD_RANGE, make
from rejeu.core.algorithm import PyTree
from rejeu.core.normalization import NormalizationConfig
from rejeu.core.schedules import Linear, Schedule
from rejeu.networks import Widths
from rejeu.networks.projected import NormalizedMLP

__all__ = ["Config", "make"]
ACTOR_LAYERS = (256, 256, 256, 256)
"""Default widths of the actor."""
CRITIC_LAYERS = (512, 512, 512, 512)
"""Default widths of each critic."""


@dataclass(frozen=True, kw_only=True)
class Config(flashsac.Config):
    """Hyperparameters of XQC; the defaults are those of the authors."""

    learning_rate: float | Schedule = Linear(3e-4, 3e-5)
    batch_size: int = 256
    tau: float = 0.005
    learning_starts: int = 5_000
    gradient_steps: int = 2
    target_entropy: float | str = "auto"
    noise_repeat: int = 1
    normalize: NormalizationConfig | None = NormalizationConfig(norm_obs=False)
    policy_delay: int = 3

    name: ClassVar[str] = "XQC"
    entropy_per_action: ClassVar[float] = -0.5
    reads_both: ClassVar[bool] = False
    hidden_layers: ClassVar[Widths] = Widths(ACTOR_LAYERS, CRITIC_LAYERS)
    hidden_layers_on_images: ClassVar[Widths] = hidden_layers

    def check_widths(self) -> None:
        """Raises nothing: layers may have any width."""

    def torso(self, key: Array, n_inputs: int, widths: tuple[int, ...]) -> PyTree:
        return NormalizedMLP(key, n_inputs, widths, self.policy_kwargs.activation_fn)

    def log_std(self, outputs: Array) -> Array:
        return jnp.clip(outputs, *LOG_STD_RANGE)
