"""Results as JSON, for the option ``--json``: one document on standard output, and nothing else there."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from typing import Any

import msgspec
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

    >>> import math, pathlib
    >>> print(dumps({"steps": np.int64(3), "return": math.nan, "path": pathlib.PurePosixPath("runs/a")}))
    {
      "steps": 3,
      "return": null,
      "path": "runs/a"
    }
    """
    return msgspec.json.format(msgspec.json.encode(value, enc_hook=plain), indent=2).decode()


def plain(value: Any) -> Any:
    """Returns a NumPy array or number as Python's, a mapping as a dict, and anything else as text."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    return dict(value) if isinstance(value, Mapping) else str(value)
