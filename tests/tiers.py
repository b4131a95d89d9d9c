"""Which tests run by default, and which only in the exhaustive tier (``scripts/test --all``).

A test is exhaustive by its mark, or by its line in ``dear.txt``: tests that take over 0.3 s with an empty cache of compiled
programs, none of which alone notices a planted bug (``trials/mutations.py``), and whose code path a test of the default tier
takes too.
"""

from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest

exhaustive = pytest.mark.exhaustive
DEAR = frozenset(Path(__file__).with_name("dear.txt").read_text(encoding="utf-8").splitlines())
"""Ids of tests, as pytest prints them."""


def only(default: Collection[Any], values: Iterable[Any]) -> list[Any]:
    """Returns ``values``. Those that are not in ``default`` belong to the exhaustive tier."""
    return [value if value in default else pytest.param(value, marks=exhaustive) for value in values]


def only_tuples(default: Collection[Any], values: Iterable[Any]) -> list[Any]:
    """Likewise for several parameters at once, whose values are tuples."""
    return [value if value in default else pytest.param(*value, marks=exhaustive) for value in values]


def crossed(first: Sequence[Any], second: Sequence[Any]) -> list[Any]:
    """Returns all pairs. By default only those of a diagonal run, which contains every value of both.

    >>> [getattr(pair, "values", pair) for pair in crossed("ab", [1, 2])]
    [('a', 1), ('a', 2), ('b', 1), ('b', 2)]
    """
    period = min(len(first), len(second))
    return [
        (a, b) if i % period == j % period else pytest.param(a, b, marks=exhaustive)
        for i, a in enumerate(first)
        for j, b in enumerate(second)
    ]
