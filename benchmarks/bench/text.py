"""Formatting of numbers and tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from benchmarks.bench.summary import ByRound, Limit, Sample, Spread, ratio, spread

Row = Sequence[str]
NAMES = {"rejeu": "rejeu", "sb3": "Stable-Baselines3", "sbx": "SBX"}


def number(value: float) -> str:
    """Formats a number with three significant figures.

    >>> [number(x) for x in (0.1234, 2.5, 1234.0)]
    ['0.123', '2.5', '1,234']
    """
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def table(header: Row, rows: Iterable[Row]) -> str:
    """Returns a Markdown table.

    >>> print(table(("a", "b"), [("1", "2")]))
    | a | b |
    |---|---|
    | 1 | 2 |
    """
    lines = [header, ["---"] * len(header), *rows]
    text = ["| " + " | ".join(line) + " |" for line in lines]
    text[1] = "|" + "---|" * len(header)
    return "\n".join(text)


def with_spread(numbers: ByRound, scale: float = 1.0) -> str:
    """Returns the median as text, with minimum and maximum if there are several values.

    >>> with_spread({0: 0.002, 1: 0.004, 2: 0.003}, 1e3), with_spread({0: 1.5}), with_spread({})
    ('3 (2 to 4)', '1.5', '')
    """
    if not numbers:
        return ""
    statistics = spread(numbers)
    if len(numbers) == 1:
        return number(scale * statistics.median)
    return (
        f"{number(scale * statistics.median)} ({number(scale * statistics.low)} to {number(scale * statistics.high)})"
    )


def times(speedup: Spread | None) -> str:
    """Returns the speedup as text, empty if unknown."""
    return "" if speedup is None else f"{speedup.median:.2f}" if speedup.median < 10 else f"{speedup.median:.1f}"


def times_of_most(peer: ByRound, rejeu: ByRound, limit: Limit | None) -> str:
    """Returns the speedup over another library, and the speedup that a program at the limit would have.

    >>> times_of_most({0: 8.0, 1: 12.0}, {0: 2.0, 1: 3.0}, Limit(env=0.5, arithmetic=0.5, flops=1.0, share_reached=0.4))
    '4.00 of 10.0'
    """
    reached = ratio(peer, rejeu)
    if reached is None or limit is None:
        return times(reached)
    return f"{times(reached)} of {times(spread({turn: value / limit.seconds for turn, value in peer.items()}))}"


def percent(share: float) -> str:
    """Formats a fraction as a percentage."""
    return f"{100 * share:.0f} %"


def variant_of(rows: Sequence[Sample]) -> str:
    """Returns the setting with which another library was measured."""
    return rows[0]["variant"] if rows else ""
