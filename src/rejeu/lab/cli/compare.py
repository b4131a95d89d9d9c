"""``rejeu compare``: groups of runs side by side."""

from __future__ import annotations

import webbrowser
from collections.abc import Iterable
from pathlib import Path

from rejeu.core.types import JsonObject
from rejeu.lab.cli.commands import Compare
from rejeu.lab.reporting.comparison import Comparison, compare
from rejeu.logs.formatting import show_table


def run_compare(arguments: Compare) -> tuple[int, JsonObject]:
    """Compares runs, prints a table, and writes what was asked for."""
    options = {name: getattr(arguments, name) for name in ("by", "x", "score", "statistic", "threshold")}
    normalize = references(arguments.reference) or arguments.normalize
    comparison = compare(arguments.runs, normalize=normalize, **options)
    out = arguments.out or (Path("compare.html") if arguments.open else None)
    written = [] if out is None else comparison.save(out)
    if not arguments.json:
        show_comparison(comparison)
        for path in written:
            print(path)
    pages = [path for path in written if path.suffix == ".html"]
    if arguments.open and pages:
        webbrowser.open(pages[0].absolute().as_uri())
    return 0, comparison.to_dict()


def references(words: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Returns the reference returns of environments.

    Raises:
        ValueError: for a word that is not ENV=LOW,HIGH.

    >>> references(["CartPole-v1=22,500"])
    {'CartPole-v1': (22.0, 500.0)}
    """
    bounds = {}
    for word in words:
        env, _, values = word.rpartition("=")
        try:
            low, high = map(float, values.split(","))
        except ValueError:
            raise ValueError(f"--reference {word!r} must be ENV=LOW,HIGH, such as CartPole-v1=22,500") from None
        bounds[env] = low, high
    return bounds


def show_comparison(comparison: Comparison) -> None:
    """Prints the tables and the notes."""
    from rich.console import Console
    from rich.markup import escape

    head, *rows = comparison.text_table()
    show_table(head, rows, 2)
    console = Console(highlight=False)
    console.print(comparison.definition, soft_wrap=True)
    for improvement in comparison.improvements:
        better, worse, env, text = map(escape, improvement.cells)
        console.print(f"{better} scores higher than {worse} on {env} with probability {text}", soft_wrap=True)
    for note in comparison.notes:
        console.print(f"note: {escape(note)}", soft_wrap=True)
