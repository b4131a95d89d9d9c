"""What a preset is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Preset:
    """How to train one algorithm on one environment, where that comes from, and what it reached here."""

    env_id: str
    """Id of the environment."""
    algorithm: str
    """Name of the algorithm, a key of ``rejeu.AGENTS``."""
    hyperparameters: Mapping[str, Any] = field(hash=False)
    """What differs from the algorithm's defaults, as the agent takes it; read-only."""
    n_envs: int
    """Environments stepped at once."""
    total_steps: int
    """Environment steps of a full run, over all environments."""
    evaluate_every: int
    """Environment steps between two evaluations."""
    evaluate_episodes: int
    """Episodes of each evaluation."""
    backend: str = "auto"
    """What steps the environments, as for ``make_vector``."""
    source: str
    """Where the hyper-parameters come from."""
    result: str
    """What this preset reached here, measured how; empty as long as nobody has measured it."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "hyperparameters", MappingProxyType(dict(self.hyperparameters)))
