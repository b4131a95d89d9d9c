"""Nested plain data as JSON and arrays by name, and back, each value of the type that it was.

What environments and callbacks remember is made of numbers, texts, lists, tuples, dicts and arrays. JSON alone would
turn tuples into lists and knows no arrays; with the two apart, both fit in a file that is safe to open.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from rejeu.errors import CheckpointError

DEEPEST = 32
"""Most levels of nesting."""


def encode(value: Any, arrays: dict[str, np.ndarray], name: str) -> Any:
    """Returns ``value`` as JSON; its arrays are added to ``arrays`` under names that begin with ``name``.

    Raises:
        TypeError: if something in it is no plain data, with its place.

    >>> arrays = {}
    >>> encode({"state": (1, np.float32(2.5))}, arrays, "env")
    {'dict': {'state': {'tuple': [1, {'scalar': 'env.state.1'}]}}}
    >>> arrays
    {'env.state.1': array(2.5, dtype=float32)}
    """
    if value is None or isinstance(value, bool | str) or type(value) is int:
        return value
    if type(value) is float:
        return value if math.isfinite(value) else {"float": repr(value)}
    if isinstance(value, np.generic | np.ndarray) and value.dtype.kind in "biuf":
        arrays[name] = np.array(value)
        return {"array" if isinstance(value, np.ndarray) else "scalar": name}
    if isinstance(value, list | tuple):
        parts = [encode(part, arrays, f"{name}.{i}") for i, part in enumerate(value)]
        return parts if isinstance(value, list) else {"tuple": parts}
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {"dict": {key: encode(part, arrays, f"{name}.{key}") for key, part in value.items()}}
    raise TypeError(
        f"{name} is a {type(value).__name__}; only numbers, texts, lists, tuples, dicts and arrays are kept"
    )


def decode(value: Any, arrays: Mapping[str, np.ndarray], depth: int = 0) -> Any:
    """Returns what :func:`encode` was given.

    Raises:
        CheckpointError: if it is nothing that :func:`encode` returns.
    """
    if depth > DEEPEST:
        raise CheckpointError(f"plain data is nested more than {DEEPEST} deep; the file is damaged")
    if isinstance(value, list):
        return [decode(part, arrays, depth + 1) for part in value]
    if not isinstance(value, dict):
        return value
    kind, content = next(iter(value.items())) if len(value) == 1 else (None, None)
    if kind == "dict" and isinstance(content, dict):
        return {key: decode(part, arrays, depth + 1) for key, part in content.items()}
    if kind == "tuple" and isinstance(content, list):
        return tuple(decode(part, arrays, depth + 1) for part in content)
    if kind == "float" and content in ("nan", "inf", "-inf"):
        return float(content)
    if kind in ("array", "scalar") and isinstance(content, str) and content in arrays:
        return arrays[content] if kind == "array" else arrays[content][()]
    raise CheckpointError("plain data has an unknown form; the file is damaged")
