"""Tables on the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rejeu.reporting import notebook

WIDE = 10_000
"""Columns of what is no terminal, such as a pipe: nothing is folded, so that ``grep`` finds whole names."""


def show(head: Sequence[str], rows: Iterable[Sequence[str]], n_text: int) -> None:
    """Prints a table. A narrow terminal folds the first ``n_text`` columns, which are text; numbers are never folded."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=box.SIMPLE, collapse_padding=True, pad_edge=False)
    for i, name in enumerate(head):
        is_text = i < n_text
        table.add_column(name, justify="left" if is_text else "right", overflow="fold", no_wrap=not is_text)
    for row in rows:
        table.add_row(*map(escape, row))
    console = notebook.console(highlight=False)
    if not console.is_terminal:
        console = notebook.console(highlight=False, width=WIDE)
    console.print(table)
