"""How far the runs of an experiment are: a table on a terminal, as ``rejeu runs`` shows it, and lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

from rejeu.lab.experiments.scheduler import Scheduler
from rejeu.lab.reporting.rows import COLUMNS, N_TEXT, Row, RowReader, best_text, steps_text, texts
from rejeu.logs.formatting import console, table_of

REFRESH, LINES = 2.0, 30.0
"""Seconds between two readings of the tables of the runs: on a terminal, and elsewhere."""
MAX_NAMED = 4
"""Most runs that are named in a line."""


@contextmanager
def shown(scheduler: Scheduler, summary: Callable[[], str], progress: bool = True) -> Iterator[Callable[[], None]]:
    """Context in which the runs that train are shown; returns a function to call often.

    Args:
        scheduler: of the runs.
        summary: returns how far all of them are, as a line.
        progress: whether anything is shown.
    """
    from rich.console import Group
    from rich.live import Live

    to, reader = console(highlight=False), RowReader(Path())
    table = Live(console=to, auto_refresh=False, transient=True) if progress and to.is_terminal else None
    due = time.monotonic() + (LINES if table is None else 0.0)

    def watch() -> None:
        nonlocal due
        if not progress or not scheduler.running or time.monotonic() < due:
            return
        due = time.monotonic() + (LINES if table is None else REFRESH)
        rows = rows_of(scheduler, reader)
        if table is None:
            print("; ".join([*line(rows), summary()]), flush=True)
        else:
            table.update(Group(table_of(COLUMNS, map(texts, rows), N_TEXT), summary()), refresh=True)

    with nullcontext() if table is None else table:
        yield watch


def rows_of(scheduler: Scheduler, reader: RowReader) -> list[Row]:
    """Returns the rows of the runs that train."""
    works = [attempt.work for attempt in scheduler.running]
    return [replace(reader.row(work.path), run=work.name, state="running") for work in works]


def line(rows: Sequence[Row]) -> list[str]:
    """Returns how far the first runs are."""
    return [f"{row.run} {steps_text(row)} steps, return {best_text(row)}" for row in rows[:MAX_NAMED]]
