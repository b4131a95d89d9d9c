"""Formatting of counts and of tables in notebooks."""

from __future__ import annotations

import html
import os
import shlex
import subprocess
from collections.abc import Iterable


def counted(n: int, noun: str) -> str:
    """Returns a count with its noun in singular or plural.

    >>> counted(1, "episode"), counted(1200, "episode")
    ('1 episode', '1,200 episodes')
    """
    return f"{n:,} {noun}{'' if n == 1 else 's'}"


def quoted(word: object) -> str:
    """Returns a word of a command line as it is typed: in quotes where the shell needs them.

    >>> quoted("runs/first")
    'runs/first'
    """
    return subprocess.list2cmdline([str(word)]) if os.name == "nt" else shlex.quote(str(word))


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
