"""The fields of a preset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Tuned settings of one algorithm for one environment."""

    env_id: str
    """Id of the environment."""
    algorithm: str
    """Name of the algorithm, a key of ``rejeu.AGENTS``."""
    hyperparameters: Mapping[str, Any] = field(hash=False)
    """Hyperparameters that differ from the algorithm's defaults, as keyword arguments of the agent; read-only."""
    n_envs: int
    """Number of parallel environments."""
    total_steps: int
    """Environment steps of a full run, over all environments."""
    evaluate_every: int
    """Environment steps between two evaluations."""
    evaluate_episodes: int
    """Episodes of each evaluation."""
    backend: str = "auto"
    """Backend of the environments, as for ``make_vector``."""
    source: str
    """Origin of the hyperparameters."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "hyperparameters", MappingProxyType(dict(self.hyperparameters)))
