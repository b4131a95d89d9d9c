"""Numbers, words and tables as text: for the terminal, notebooks, Markdown and CSV; and where notebooks show them."""

from __future__ import annotations

import csv
import html
import io
import math
import os
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rejeu.core.records import shown

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

FORMULA = ("=", "+", "-", "@")
"""Characters with which a spreadsheet begins a formula."""

WIDE = 10_000
"""Columns of a table that is not written to a terminal, so that no cell is folded."""

LOGS = ("csv", "json", "tensorboard", "wandb", "mlflow", "trackio")
"""Names of outputs that the argument ``log`` takes."""


def counted(n: int, noun: str) -> str:
    """Returns a count with its noun in singular or plural.

    >>> counted(1, "episode"), counted(1200, "episode")
    ('1 episode', '1,200 episodes')
    """
    return f"{n:,} {noun}{'' if n == 1 else 's'}"


def html_table(rows: Iterable[Iterable[str]]) -> str:
    """Returns a table whose first row and first column are headings; the text is escaped.

    >>> html_table([["", "mean"], ["<x>", "1"]])
    '<table><tr><th></th><th>mean</th></tr><tr><th>&lt;x&gt;</th><td>1</td></tr></table>'
    """
    lines = []
    for i, row in enumerate(rows):
        cells = [(html.escape(cell), "td" if i and j else "th") for j, cell in enumerate(row)]
        lines.append("".join(f"<{tag}>{cell}</{tag}>" for cell, tag in cells))
    return "<table>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"


def aligned(rows: Iterable[Sequence[str]], gap: str = "  ") -> str:
    """Returns rows of cells as lines with aligned columns; numbers, and what begins with one, are aligned to the right.

    >>> print(aligned([("a", "10"), ("bcd", "-7")]))
    a    10
    bcd  -7
    """
    rows = [*rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(gap.join(map(_padded, row, widths)).rstrip() for row in rows)


def _padded(text: str, width: int) -> str:
    return text.rjust(width) if text.lstrip("-")[:1].isdigit() else text.ljust(width)


def number(value: float) -> str:
    """Returns a number for a table, with four significant digits; ``-`` if it is not finite.

    >>> number(1234567.0), number(0.012345), number(1e30), number(math.inf)
    ('1,234,567', '0.01235', '1e+30', '-')
    """
    if not math.isfinite(value):
        return "-"
    return f"{value:,.0f}" if 1000 <= abs(value) < 1e12 else f"{value:.4g}"


def duration(seconds: float) -> str:
    """Returns a time in words, a dash if it is unknown.

    >>> duration(75), duration(4000), duration(7.25), duration(7)
    ('1 min 15 s', '1 h 6 min', '7.25 s', '7 s')
    """
    if not math.isfinite(seconds) or seconds < 0:
        return "\N{EN DASH}"
    if seconds < 60:
        return f"{seconds:.3g} s"
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours:,} h {minutes} min" if hours else f"{minutes} min {seconds} s"


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell(text) for text in line) + " |" for line in lines)


def cell(value: str) -> str:
    """Returns text so that it shows literally in a cell of Markdown."""
    for character in "\\|<>[]`*_~&#":
        value = value.replace(character, "\\" + character)
    return shown(value, 400)


def csv_text(rows: Iterable[Mapping[str, object]]) -> str:
    """Returns rows as CSV. Text that a spreadsheet would take for a formula gets an apostrophe."""

    def as_text(value: object) -> object:
        return f"'{value}" if isinstance(value, str) and value[:1] in FORMULA else value

    rows = [{key: as_text(value) for key, value in row.items()} for row in rows]
    out = io.StringIO()
    writer = csv.DictWriter(out, list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


def console(**settings: Any) -> Console:
    """Returns a console of Rich for standard output that is a terminal only if standard output is one.

    Notebooks set ``FORCE_COLOR`` for the commands of their cells. Rich would then animate bars and tables there, and every
    frame would be saved with the notebook.
    """
    from rich.console import Console

    is_terminal = getattr(sys.stdout, "isatty", bool)()
    return Console(force_terminal=None if is_terminal else False, **settings)


def show_table(head: Sequence[str], rows: Iterable[Sequence[str]], n_text: int) -> None:
    """Prints a table; see :func:`table_of`."""
    to = console(highlight=False)
    if not to.is_terminal:
        to = console(highlight=False, width=WIDE)
    to.print(table_of(head, rows, n_text))


def table_of(head: Sequence[str], rows: Iterable[Sequence[str]], n_text: int) -> Table:
    """Returns a table. A narrow terminal folds the first ``n_text`` columns, which are text; numbers are never folded."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=box.SIMPLE, collapse_padding=True, pad_edge=False)
    for i, name in enumerate(head):
        is_text = i < n_text
        table.add_column(name, justify="left" if is_text else "right", overflow="fold", no_wrap=not is_text)
    for row in rows:
        table.add_row(*map(escape, row))
    return table


class Display:
    """An output of a cell whose text can be replaced. Mutable; for notebooks only.

    Unlike a widget it is saved with the notebook, and needs no package but IPython.
    """

    def __init__(self) -> None:
        self._handle: Any = None

    def show(self, text: str) -> None:
        """Replaces the text, which is shown in a monospaced font."""
        from IPython.display import display

        data = {"text/plain": text}
        if self._handle is None:
            self._handle = display(data, raw=True, display_id=True)
        else:
            self._handle.update(data, raw=True)


def quoted(word: object) -> str:
    """Returns a word of a command line as it is typed: in quotes where the shell needs them."""
    return subprocess.list2cmdline([str(word)]) if os.name == "nt" else shlex.quote(str(word))
