"""What a run needs on a cluster."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rejeu.validation import assign, coerce, number

UNITS = {"": 1, "B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}


@dataclass(frozen=True, kw_only=True)
class Resources:
    """What one run needs on a node of a Ray cluster; Ray starts no more runs on a node than fit."""

    cpus: float = 1
    """Processor cores."""
    gpus: float = 0
    """GPUs; a fraction shares one."""
    memory: int | str | None = None
    """Memory in bytes, or as ``"4 GB"``; None reserves none."""
    custom: dict[str, float] = field(default_factory=dict)
    """Ray's custom resources by name."""

    def __post_init__(self) -> None:
        coerce(self, "cpus", number, above=0, most=10_000)
        coerce(self, "gpus", number, least=0, most=1000)
        assign(self, memory=None if self.memory is None else memory_bytes(self.memory))
        if not isinstance(self.custom, Mapping) or len(self.custom) > 100:
            raise TypeError(f"custom={self.custom!r} must be a table of up to 100 numbers")
        assign(self, custom={str(key): number(f"custom.{key}", value, above=0) for key, value in self.custom.items()})


def memory_bytes(value: Any) -> int:
    """Returns an amount of memory in bytes.

    Raises:
        ValueError: if it is none.

    >>> memory_bytes("1.5 GB"), memory_bytes(1000)
    (1500000000, 1000)
    """
    found = re.fullmatch(r"(\d{1,15}(?:\.\d{1,6})?) ?([KMGT]?B)?", str(value))
    if isinstance(value, bool) or found is None or float(found[1]) <= 0:
        raise ValueError(f"memory={value!r} must be a number of bytes, or a text such as '4 GB'")
    return int(float(found[1]) * UNITS[found[2] or ""])
