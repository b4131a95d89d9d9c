"""``rejeu runs``: the runs in a folder, with their best results."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rejeu.cli import tables
from rejeu.cli.commands import Runs
from rejeu.cli.jsonout import emit
from rejeu.cli.status import describe
from rejeu.io.records import shown
from rejeu.reporting import run_list


def run(arguments: Runs) -> int:
    """Prints a table of the runs in a folder, or JSON, and returns the exit status."""
    rows, unreadable = [], []
    if not arguments.folder.exists():
        raise FileNotFoundError(f"there is no folder {arguments.folder}; rejeu train ENV makes runs in the folder runs")
    for path in run_list.find(arguments.folder):
        try:
            rows.append({"run": str(path), **describe(run_list.read(path))})
        except (OSError, ValueError, ImportError) as error:
            unreadable.append(shown(f"{path}: {error}", 300))
    if arguments.json:
        emit({"runs": rows, "unreadable": unreadable})
        return 0
    if rows:
        show(rows)
    else:
        print(f"there are no runs in {arguments.folder}; rejeu train ENV makes one")
    for one in unreadable:
        print(f"note: {one}")
    return 0


def show(rows: Sequence[Mapping[str, Any]]) -> None:
    """Prints the table."""
    head = ["run", "environment", "algorithm", "state", "steps", "best result"]
    names = ("env", "algorithm", "state")
    cells = ([shown(row["run"], 300), *(row[name] for name in names), steps_of(row), best_of(row)] for row in rows)
    tables.show(head, cells, 3)


def steps_of(row: Mapping[str, Any]) -> str:
    """Returns the steps done, with their share of those asked for, unless all are done."""
    done, asked = row["steps"], row["steps_asked"]
    return f"{done:,} ({done / asked:.0%})" if asked and done < asked else f"{done:,}"


def best_of(row: Mapping[str, Any]) -> str:
    """Returns the best evaluation; of a run without one the mean return of the last training episodes."""
    best = row["best"]
    if best is None:
        return "-" if math.isnan(row["mean_return"]) else f"{row['mean_return']:,.2f} in training"
    return f"{best['mean_return']:,.2f}" + (
        "" if math.isnan(best["success_rate"]) else f", {best['success_rate']:.0%} success"
    )
