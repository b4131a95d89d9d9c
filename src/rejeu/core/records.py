"""JSON from files: parsed strictly, and converted to typed records with ``msgspec``, which checks types and bounds.

The states of environments and callbacks consist of numbers, strings, lists, tuples, dicts and arrays. JSON alone would turn
tuples into lists and has no arrays: :func:`encode` preserves the type of every value, and names arrays.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np
from msgspec import Meta

from rejeu.core.errors import CheckpointError, printable
from rejeu.core.types import JsonObject

T = TypeVar("T")

Count = Annotated[int, Meta(ge=0, le=2**62)]
"""An integer from 0."""
Positive = Annotated[int, Meta(ge=1, le=2**62)]
"""An integer from 1."""
Seed = Annotated[int, Meta(ge=0, le=2**32 - 1)]
"""The seed of a NumPy generator."""
MAX_DEPTH = 100
"""Upper limit on the levels of a JSON document; much deeper ones exceed Python's recursion limit where they are written."""
MAX_ENVS = 4096
"""Upper limit on the environments that a file may ask for."""
EnvCount = Annotated[int, Meta(ge=1, le=MAX_ENVS)]
Seconds = Annotated[float, Meta(ge=0, le=1e300)]
Duration = Annotated[float, Meta(gt=0, le=1e300)]
"""Seconds or minutes, more than none."""


WRONG = (ArithmeticError, AttributeError, LookupError, MemoryError, RecursionError, TypeError, ValueError)
"""Exceptions that invalid values of a file can cause where they are used."""


class Malformed(ValueError):
    """A file does not follow its format; the message says where."""


def parse_json(text: str | bytes) -> Any:
    """Returns the value of a JSON document; NaN, infinities and numbers of more than 300 digits are not JSON.

    Raises:
        Malformed: if the document is not valid.

    >>> parse_json('{"a": NaN}')
    Traceback (most recent call last):
        ...
    rejeu.core.records.Malformed: it is not valid JSON: JSON is malformed: invalid character (byte 6)
    """
    try:
        value = msgspec.json.decode(text)
        if is_deep(value, MAX_DEPTH):
            raise RecursionError
        return value
    except RecursionError:
        raise Malformed("it is nested too deeply") from None
    except ValueError as error:
        raise Malformed(f"it is not valid JSON: {str(error)[:80]}") from None


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """Returns the content of a file.

    Raises:
        Malformed: if it has more than ``max_bytes`` bytes; no more of it is read.
        OSError: if it cannot be read.
    """
    with path.open("rb") as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise Malformed(f"it has more than {max_bytes:,} bytes")
    return data


def stored_size(path: Path) -> int:
    """Returns the bytes of a file; of a sparse file, without its holes."""
    status = path.stat()
    return min(status.st_size, 512 * getattr(status, "st_blocks", status.st_size))


def is_sparse(path: Path) -> bool:
    """Returns whether a large file is nearly all holes: it takes no room in an archive, and gigabytes when it is read."""
    return path.stat().st_size > 2**24 + 16 * stored_size(path)


def read_json(path: Path, max_bytes: int) -> Any:
    """Returns the value of a JSON file of at most ``max_bytes`` bytes; raises as :func:`read_bytes` and :func:`parse_json`."""
    return parse_json(read_bytes(path, max_bytes))


def json_text(value: object, indent: int = 1) -> str:
    """Returns JSON values, also in dataclasses, as the text of a file.

    Raises:
        TypeError, ValueError: if a value is not one of JSON, or not finite.
    """
    return json.dumps(value, indent=indent, allow_nan=False, default=_as_dict) + "\n"


def _as_dict(value: Any) -> JsonObject:
    """Returns a mapping, or the fields of a dataclass, as a dict."""
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, type):
        raise TypeError(f"{value!r} is no value of JSON")
    return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}


def convert(value: object, record_type: type[T]) -> T:
    """Returns a JSON value, or one with arrays, as a record of type ``record_type``.

    Raises:
        CheckpointError: if types or bounds differ; it names the field, what was received and what was expected.

    >>> convert([-1], list[Count])
    Traceback (most recent call last):
        ...
    rejeu.core.errors.CheckpointError: [0]=-1: expected `int` >= 0
    """
    try:
        return msgspec.convert(value, record_type)
    except msgspec.ValidationError as error:
        problem, _, path = str(error).partition(" - at ")
        raise CheckpointError(f"{_received(value, path)}{problem[:1].lower()}{problem[1:]}") from None


def is_deep(value: object, max_depth: int) -> bool:
    """Returns whether a JSON value has more than ``max_depth`` levels."""
    level = [value]
    for _ in range(max_depth):
        children = [
            node.values() if isinstance(node, dict) else node for node in level if isinstance(node, dict | list)
        ]
        level = [child for nodes in children for child in nodes]
        if not level:
            break
    return bool(level)


def shown(value: object, length: int = 100) -> str:
    r"""Returns a value from a file as an error message may contain it: on one line, and shortened.

    >>> print(shown("héros\u202e\n"))
    héros\u202e\n
    """
    text = printable(str(value)[: length + 1])
    return text if len(text) <= length else text[: length - 3] + "..."


def utf8(text: object) -> str:
    r"""Returns a text in which is escaped what UTF-8 cannot encode, such as other bytes in the name of a file.

    >>> print(utf8(b"bad\xff".decode("utf-8", "surrogateescape")))
    bad\udcff
    """
    return str(text).encode("utf-8", "backslashreplace").decode()


def brief(error: BaseException) -> str:
    """Returns the message of an error on one line, shortened."""
    return shown(" ".join((str(error) or type(error).__name__).split()), 400)


def _received(value: Any, path: str) -> str:
    """Returns ``field=value: `` for a path such as ``$.counters.step``, or the path alone where it has no index."""
    name = path.replace("`", "").removeprefix("$").lstrip(".")
    if not name or "..." in name or " " in name:
        return f"{name}: " if name else ""
    for key, index in re.findall(r"([^.\[\]]+)|\[(\d+)\]", name):
        value = value[key] if key else value[int(index)]
    return f"{name}={shown(repr(value), 40)}: "


def encode(value: object, arrays: dict[str, np.ndarray], name: str) -> Any:
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
        parts = [encode(child, arrays, f"{name}.{i}") for i, child in enumerate(value)]
        return parts if isinstance(value, list) else {"tuple": parts}
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {"dict": {key: encode(child, arrays, f"{name}.{key}") for key, child in value.items()}}
    raise TypeError(f"{name} is a {type(value).__name__}; expected numbers, strings, lists, tuples, dicts and arrays")


def decode(value: object, arrays: Mapping[str, np.ndarray]) -> Any:
    """Returns the value that :func:`encode` encoded.

    Raises:
        CheckpointError: if ``value`` cannot come from :func:`encode`.
    """
    if isinstance(value, list):
        return [decode(child, arrays) for child in value]
    if not isinstance(value, dict):
        return value
    tag, content = next(iter(value.items())) if len(value) == 1 else (None, None)
    if tag == "dict" and isinstance(content, dict):
        return {key: decode(child, arrays) for key, child in content.items()}
    if tag == "tuple" and isinstance(content, list):
        return tuple(decode(child, arrays) for child in content)
    if tag == "float" and content in ("nan", "inf", "-inf"):
        return float(content)
    if tag in ("array", "scalar") and isinstance(content, str) and content in arrays:
        return arrays[content] if tag == "array" else arrays[content][()]
    raise CheckpointError("the data have an unknown form; the file is damaged")
