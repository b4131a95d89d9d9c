"""Numbers of a comparison as text: for the terminal, Markdown, CSV and JSON."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from rejeu.io.records import shown


def improvement_row(one: Any) -> list[str]:
    """Returns the cells of a probability of improvement."""
    return [one.label, one.other, one.env_id, f"{one.probability:.0%} ({one.low:.0%} to {one.high:.0%})"]


def interval_text(group: Any) -> str:
    """Returns the score of a group with its interval as text."""
    value, low, high = map(number, group.score)
    return f"IQM {value} (95 % interval {low} to {high}), {len(group.runs)} run{'s' * (len(group.runs) != 1)}"


def reached_text(group: Any) -> str:
    """Returns the steps, or the time, to the threshold as text, with the number of runs that reached it."""
    count, time, level = group.reached
    return f"{number(time)} ({count} of {len(group.runs)} reach {number(level)})"


def number(value: float) -> str:
    """Returns a number for a table, with four significant digits; ``-`` if it is not finite.

    >>> number(1234567.0), number(0.012345), number(1e30), number(math.inf)
    ('1,234,567', '0.01235', '1e+30', '-')
    """
    if not math.isfinite(value):
        return "-"
    return f"{value:,.0f}" if 1000 <= abs(value) < 1e12 else f"{value:.4g}"


def curve_parts(values: np.ndarray) -> dict[str, list[float]]:
    """Returns the rows of a curve by name."""
    return dict(zip(("value", "low", "high"), values.tolist(), strict=True))


def without_nan(value: Any) -> Any:
    """Returns JSON values in which NaN and infinities are None."""
    if isinstance(value, dict):
        return {key: without_nan(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell(one) for one in line) + " |" for line in lines)


def cell(value: str) -> str:
    """Returns text so that it shows literally in a cell of Markdown."""
    for character in "\\|<>[]`*":
        value = value.replace(character, "\\" + character)
    return shown(value, 400)


def csv_text(rows: Iterable[Mapping[str, Any]]) -> str:
    """Returns rows as CSV. Text that a spreadsheet would take for a formula gets an apostrophe."""
    rows = [{key: safe(value) for key, value in row.items()} for row in rows]
    out = io.StringIO()
    writer = csv.DictWriter(out, list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


def safe(value: Any) -> Any:
    """Returns a cell for a spreadsheet."""
    return "'" + value if isinstance(value, str) and value[:1] in ("=", "+", "-", "@") else value
