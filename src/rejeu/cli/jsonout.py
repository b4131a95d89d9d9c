"""Results as JSON, for the option ``--json``: one document on standard output, and nothing else there."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from typing import Any

import numpy as np


@contextmanager
def messages(is_json: bool) -> Iterator[Callable[[Any], None]]:
    """Context that yields a function to call with the result, which prints it with ``is_json`` and else does nothing.

    With ``is_json``, what is printed otherwise goes to standard error.
    """
    if not is_json:
        yield lambda result: None
        return
    output = sys.stdout
    with redirect_stdout(sys.stderr):
        yield lambda result: print(dumps(result), file=output, flush=True)


def dumps(value: Any) -> str:
    """Returns a value as indented JSON text. NaN and infinities become null, since JSON has none.

    >>> print(dumps({"steps": np.int64(3), "return": math.nan}))
    {
      "steps": 3,
      "return": null
    }
    """
    return json.dumps(plain(value), indent=2, allow_nan=False)


def plain(value: Any) -> Any:
    """Returns a value as JSON values: dicts, lists, strings, numbers, true, false and null.

    >>> plain((True, np.array([1.0, math.inf])))
    [True, [1.0, None]]
    """
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(one) for one in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
