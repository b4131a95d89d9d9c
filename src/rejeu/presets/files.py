"""Presets as JSON files: what ``rejeu tune`` finds and ``rejeu train --preset`` uses. A file is untrusted data."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from rejeu.errors import CheckpointError
from rejeu.io import atomic
from rejeu.io.records import EnvCount, Malformed, Positive, convert, read_json, shown
from rejeu.presets.preset import Preset

MAX_BYTES = 2**20
"""Upper limit on the size of a file."""
Name = Annotated[str, Meta(min_length=1, max_length=200)]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Content:
    """The fields of a file; their meanings are those of :class:`Preset`."""

    env_id: Name
    algorithm: Name
    hyperparameters: dict[str, Any]
    n_envs: EnvCount
    total_steps: Positive
    evaluate_every: Positive
    evaluate_episodes: Annotated[int, Meta(ge=1, le=10_000)]
    backend: Annotated[str, Meta(pattern="^(auto|envpool|gymnasium|gymnasium-async|jax)$")] = "auto"
    source: Annotated[str, Meta(max_length=1000)] = ""


def write(preset: Preset, path: str | Path) -> Path:
    """Writes a preset to a JSON file and returns its path.

    Raises:
        TypeError: if a hyperparameter is not a JSON value, such as a network of your own.
    """
    fields = {field.name: getattr(preset, field.name) for field in dataclasses.fields(preset)}
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
        content = convert(read_json(path, MAX_BYTES), Content)
        return Preset(**{one.name: getattr(content, one.name) for one in dataclasses.fields(Content)})
    except (Malformed, CheckpointError) as error:
        raise CheckpointError(f"{path} is no preset: {shown(error, 1000)}") from None
