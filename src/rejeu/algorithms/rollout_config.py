"""The hyperparameters of every algorithm that learns from rollouts: what the loops and the rollout buffer read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from rejeu.algorithms import search
from rejeu.algorithms.config import AlgorithmConfig
from rejeu.algorithms.search import SearchSpace
from rejeu.core.validation import coerce, whole
from rejeu.networks import Widths


@dataclass(frozen=True, kw_only=True)
class RolloutConfig(AlgorithmConfig):
    """The hyperparameters of every algorithm that learns from rollouts of its present policy."""

    n_steps: int = 2048
    """Steps of each environment between two updates. A larger number estimates the gradient better and updates less
    often."""
    n_episodes: int | None = None
    """Complete episodes of each environment between two updates, instead of ``n_steps``; environments that are done wait
    for the others. Without a time limit an episode ends after ``n_steps`` steps, and the history leaves it out. None uses
    ``n_steps``."""

    max_grad_norm: float | None = 0.5

    hidden_layers: ClassVar[Widths] = Widths((64, 64), (64, 64))
    hidden_layers_on_images: ClassVar[Widths] = Widths((), ())
    search_space: ClassVar[SearchSpace] = search.ROLLOUT

    def __post_init__(self) -> None:
        AlgorithmConfig.__post_init__(self)
        coerce(self, "n_steps", whole, least=1)
        coerce(self, "n_episodes", whole, least=1, optional=True)

    def episodes(self, n_envs: int) -> int:
        """Returns the complete episodes of each of ``n_envs`` environments between two updates; 0 if steps are counted."""
        return self.n_episodes or 0

    def steps_per_gradient(self, n_envs: int) -> int:
        """Returns the number of steps of ``n_envs`` environments per gradient step."""
        return self.n_steps * n_envs

    def gradient_steps(self, n: int) -> int:
        """Returns the number of gradient steps on a rollout of ``n`` steps, if nothing stops them early."""
        return 1

    @property
    def stops_early(self) -> bool:
        """Whether the gradient steps may stop early; the metric ``gradient_steps`` is then their number."""
        return False
