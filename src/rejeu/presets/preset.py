"""What a preset is."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from types import MappingProxyType
from typing import Any


@cache
def results() -> dict[str, dict[str, str]]:
    """Returns ``results.json``: of each preset, by environment and algorithm, the figures and the text that they stand in."""
    return json.loads(resources.files("rejeu.presets").joinpath("results.json").read_text(encoding="utf-8"))


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

    @property
    def result(self) -> str:
        """What it reached here, measured how; empty as long as nobody has measured it. Intervals are of 95 %."""
        said = results().get(f"{self.env_id} {self.algorithm}")
        return "" if said is None else said["text"].format(said["figures"])

    def __post_init__(self) -> None:
        object.__setattr__(self, "hyperparameters", MappingProxyType(dict(self.hyperparameters)))
