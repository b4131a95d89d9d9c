"""A preset, and its form as a file: what ``rejeu tune`` writes and ``rejeu train --preset`` uses. A file is untrusted data."""

from __future__ import annotations

import dataclasses
import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

from msgspec import Meta

from rejeu.errors import CheckpointError
from rejeu.io import atomic
from rejeu.io.records import EnvCount, Malformed, Positive, convert, read_json, shown

MAX_BYTES = 2**20
"""Upper limit on the size of a file."""
Name = Annotated[str, Meta(min_length=1, max_length=200)]


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Tuned settings of one algorithm for one environment."""

    env_id: Name
    """Id of the environment."""
    algorithm: Name
    """Name of the algorithm, a key of ``rejeu.AGENTS``."""
    hyperparameters: Mapping[str, Any] = field(hash=False)
    """Hyperparameters that differ from the algorithm's defaults, as keyword arguments of the agent; read-only."""
    n_envs: EnvCount
    """Number of parallel environments."""
    total_steps: Positive
    """Environment steps of a full run, over all environments."""
    evaluate_every: Positive
    """Environment steps between two evaluations."""
    evaluate_episodes: Annotated[int, Meta(ge=1, le=10_000)]
    """Episodes of each evaluation."""
    backend: Annotated[str, Meta(pattern="^(auto|envpool|gymnasium|gymnasium-async|jax)$")] = "auto"
    """Backend of the environments, as for ``make_vector``."""
    source: Annotated[str, Meta(max_length=1000)] = ""
    """Origin of the hyperparameters."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "hyperparameters", MappingProxyType(dict(self.hyperparameters)))


def built_in() -> tuple[Preset, ...]:
    """Returns the presets of rejeu, in the order of ``presets.toml``."""
    text = resources.files("rejeu.presets").joinpath("presets.toml").read_text(encoding="utf-8")
    return tuple(convert(one, Preset) for one in tomllib.loads(text)["preset"])


def write(preset: Preset, path: str | Path) -> Path:
    """Writes a preset to a JSON file and returns its path.

    Raises:
        TypeError: if a hyperparameter is not a JSON value, such as a network of your own.
    """
    fields = {one.name: getattr(preset, one.name) for one in dataclasses.fields(preset)}
    try:
        text = json.dumps({**fields, "hyperparameters": dict(preset.hyperparameters)}, indent=2, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise TypeError(f"the preset of {preset.env_id} has hyperparameters that a file cannot hold: {error}") from None
    path = Path(path)
    with atomic.replacing(path) as file:
        file.write(f"{text}\n".encode())
    return path


def read(path: str | Path) -> Preset:
    """Returns the preset of a file. The hyperparameters are checked by the algorithm that they are given to.

    Raises:
        FileNotFoundError: if there is no such file.
        CheckpointError: if it is damaged, or something else than a preset.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no preset file {path}; rejeu tune writes one as preset.json")
    try:
        return convert(read_json(path, MAX_BYTES), Preset)
    except (Malformed, CheckpointError) as error:
        raise CheckpointError(f"{path} is no preset: {shown(error, 1000)}") from None
