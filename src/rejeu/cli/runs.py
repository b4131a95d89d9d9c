"""``rejeu runs``: the runs in a folder, with their best results."""

from __future__ import annotations

from rejeu.cli.commands import Runs
from rejeu.cli.jsonout import emit
from rejeu.cli.status import best_text, describe, steps_text
from rejeu.io.records import shown
from rejeu.reporting import run_list


def run(arguments: Runs) -> int:
    """Prints a table of the runs in a folder, or JSON, and returns the exit status."""
    rows, unreadable = [], []
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


def show(rows: list[dict]) -> None:
    """Prints the table."""
    from rich import box
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=box.SIMPLE)
    for name in ("run", "environment", "algorithm"):
        table.add_column(name, overflow="fold")
    for name in ("seed", "state", "steps", "best evaluation", "training return"):
        table.add_column(name, justify="left" if name == "state" else "right")
    for row in rows:
        seed = "-" if row["seed"] is None else str(row["seed"])
        last = "-" if row["mean_return"] != row["mean_return"] else f"{row['mean_return']:,.2f}"
        cells = [
            row["run"],
            row["env"],
            row["algorithm"],
            seed,
            row["state"],
            steps_text(row),
            best_text(row["best"]),
            last,
        ]
        table.add_row(*map(escape, cells))
    Console(highlight=False).print(table)
