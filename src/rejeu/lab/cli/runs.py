"""``rejeu runs`` and ``status``: the rows of runs, as the studio shows them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rejeu.core.interrupt import leaving
from rejeu.core.records import utf8
from rejeu.core.types import JsonObject
from rejeu.lab.cli.commands import Runs, Status
from rejeu.lab.reporting import run_list
from rejeu.lab.reporting.rows import COLUMNS, N_TEXT, Row, RowReader, cells, describe, texts
from rejeu.logs.formatting import console, show_table, table_of

EXIT = {"running": 0, "finished": 0, "unknown": 0, "paused": 3, "interrupted": 3, "crashed": 4, "damaged": 4}
"""Exit status of ``rejeu status`` by the state of a run."""
EVERY = 1.0
"""Seconds between two looks at the folder with ``--follow``."""


def run_runs(arguments: Runs) -> tuple[int, JsonObject]:
    """Prints a table of the runs in a folder, with ``--follow`` until Ctrl-C."""
    if not arguments.folder.exists():
        raise FileNotFoundError(f"there is no folder {arguments.folder}; rejeu train ENV makes runs in the folder runs")
    reader = RowReader(arguments.folder)
    if arguments.follow:
        follow(reader)
    rows = reader.read()
    if not arguments.json:
        show(rows, arguments.folder)
    return 0, {"runs": rows}


def run_status(arguments: Status) -> tuple[int, JsonObject]:
    """Prints the row of a run; the exit status is 3 if it was interrupted or paused, 4 if it crashed."""
    row = replace(describe(run_list.read(arguments.run)), run=utf8(arguments.run.name))
    if not arguments.json:
        show([row], arguments.run)
        print("".join(f"warning: {text}\n" for text in row.warnings), end="")
    return EXIT[row.state], vars(row)


def show(rows: Sequence[Row], folder: Path) -> None:
    """Prints rows, and a note for each thing that is wrong with a run."""
    if not rows:
        print(f"there are no runs in {folder}; rejeu train ENV makes one")
        return
    show_table(COLUMNS, map(texts, rows), N_TEXT)
    print("".join(f"note: {cells(row)['run']}: {note}\n" for row in rows for note in row.notes), end="")


def follow(reader: RowReader) -> None:
    """Shows the rows on a terminal, and when they change again, until Ctrl-C; elsewhere each time below the last."""
    from rich.live import Live

    previous: list[Row] = []
    with leaving("no longer followed"), Live(console=console(highlight=False), auto_refresh=False) as live:
        while True:
            rows = reader.read()
            if rows != previous and live.console.is_terminal:
                live.update(table_of(COLUMNS, map(texts, rows), N_TEXT), refresh=True)
            elif rows != previous:
                show_table(COLUMNS, map(texts, rows), N_TEXT)
            previous = rows
            time.sleep(EVERY)
