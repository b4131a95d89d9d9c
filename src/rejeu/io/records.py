"""JSON from files: parsed strictly, and converted to typed records with ``msgspec``, which checks types and bounds."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta

from rejeu.errors import CheckpointError

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
    rejeu.io.records.Malformed: it is not valid JSON: JSON is malformed: invalid character (byte 6)
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


def read_json(path: Path, most: int) -> Any:
    """Returns the value of a JSON file of at most ``most`` bytes.

    Raises:
        Malformed: if the file is longer, or no valid document.
        OSError: if it cannot be read.
    """
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise Malformed(f"it has more than {most:,} bytes")
    return parse_json(data)


def convert(value: Any, kind: type[T]) -> T:
    """Returns a JSON value, or one with arrays, as a record of type ``kind``.

    Raises:
        CheckpointError: if types or bounds differ; it names the field, what was received and what was expected.

    >>> convert([-1], list[Count])
    Traceback (most recent call last):
        ...
    rejeu.errors.CheckpointError: [0]=-1: expected `int` >= 0
    """
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        problem, _, place = str(error).partition(" - at ")
        raise CheckpointError(f"{_received(value, place)}{problem[:1].lower()}{problem[1:]}") from None


def is_deep(value: Any, most: int) -> bool:
    """Returns whether a JSON value has more than ``most`` levels."""
    level = [value]
    for _ in range(most):
        level = [
            child
            for one in level
            if isinstance(one, dict | list)
            for child in (one.values() if isinstance(one, dict) else one)
        ]
        if not level:
            break
    return bool(level)


def shown(value: Any, length: int = 100) -> str:
    """Returns a value from a file as an error message may contain it: on one line, and shortened."""
    text = str(value)
    text = text if text.isprintable() else ascii(text)[1:-1]
    return text if len(text) <= length else text[: length - 3] + "..."


def brief(error: BaseException) -> str:
    """Returns the message of an error on one line, shortened."""
    text = " ".join((str(error) or type(error).__name__).split())
    return text if len(text) <= 400 else text[:397] + "..."


def _received(value: Any, place: str) -> str:
    """Returns ``field=value: `` for a place such as ``$.counters.step``, or the place alone where it has no index."""
    name = place.replace("`", "").removeprefix("$").lstrip(".")
    if not name or "..." in name or " " in name:
        return f"{name}: " if name else ""
    for key, index in re.findall(r"([^.\[\]]+)|\[(\d+)\]", name):
        value = value[key] if key else value[int(index)]
    return f"{name}={shown(repr(value), 40)}: "
