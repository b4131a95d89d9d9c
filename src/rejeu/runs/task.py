"""What a process is asked to do with a run, as a file: ``rejeu --task FILE``, so that no value becomes a word of a command.

Who writes the file answers for what it imports; see :attr:`rejeu.runs.config.RunConfig.names_code`.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rejeu.io import atomic
from rejeu.io.records import Positive, convert, read_json
from rejeu.runs.config import Key, RunConfig

MAX_BYTES = 2**20
"""Upper limit on the size of the file."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """A run to begin, or to continue."""

    folder: str
    """The run folder."""
    run: RunConfig
    resume: bool = False
    """Whether it is continued from its newest checkpoint, or its files are completed; else it begins."""
    changes: dict[Key, Any] = field(default_factory=dict)
    """Hyperparameters to change where it is continued, by dotted name."""
    pause: Positive | None = None
    """Pause after so many environment steps."""
    no_report: bool = False
    no_video: bool = False


def write(path: Path, task: Task) -> None:
    """Writes the file of a task."""
    with atomic.replacing(path) as file:
        file.write(json.dumps(asdict(task), allow_nan=False).encode())


def read(path: Path) -> Task:
    """Returns what :func:`write` wrote.

    Raises:
        CheckpointError, ValueError: if it is damaged.
    """
    return convert(read_json(path, MAX_BYTES), Task)
