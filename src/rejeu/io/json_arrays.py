"""Nested data as JSON and named arrays, and back, with the type of every value preserved.

The states of environments and callbacks consist of numbers, strings, lists, tuples, dicts and arrays. JSON alone would turn
tuples into lists and has no arrays.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from rejeu.errors import CheckpointError

MAX_DEPTH = 32
"""Upper limit on the levels of nesting."""


def encode(value: Any, arrays: dict[str, np.ndarray], name: str) -> Any:
    """Returns ``value`` as JSON; its arrays are added to ``arrays`` under names that begin with ``name``.

    Raises:
        TypeError: for a value of another type; it names its place.

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
    raise TypeError(f"{name} is a {type(value).__name__}; expected numbers, strings, lists, tuples, dicts and arrays")


def decode(value: Any, arrays: Mapping[str, np.ndarray], depth: int = 0) -> Any:
    """Returns the value that :func:`encode` encoded.

    Raises:
        CheckpointError: if ``value`` cannot come from :func:`encode`.
    """
    if depth > MAX_DEPTH:
        raise CheckpointError(f"the data are nested more than {MAX_DEPTH} deep; the file is damaged")
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
    raise CheckpointError("the data have an unknown form; the file is damaged")
