"""``rejeu compare``: groups of runs with curves, scores and intervals."""

from __future__ import annotations

import webbrowser
from collections.abc import Iterable
from pathlib import Path

from rejeu.cli import tables
from rejeu.cli.commands import Compare
from rejeu.cli.jsonout import emit
from rejeu.reporting.comparison import Comparison, Group, compare
from rejeu.reporting.tabular import improvement_row, number


def run(arguments: Compare) -> int:
    """Compares runs, prints a table or JSON, writes what was asked for and returns the exit status."""
    pairs = references(word for group in arguments.reference for word in group)
    comparison = compare(
        arguments.runs,
        arguments.by,
        x=arguments.x,
        score=arguments.score,
        statistic=arguments.statistic,
        normalize=pairs or arguments.normalize,
        threshold=arguments.threshold,
    )
    out = arguments.out or (Path("compare.html") if arguments.open else None)
    written = [] if out is None else comparison.save(out)
    if arguments.json:
        emit(comparison.to_dict())
    else:
        show(comparison)
        for path in written:
            print(path)
    pages = [path for path in written if path.suffix == ".html"]
    if arguments.open and pages:
        webbrowser.open(pages[0].absolute().as_uri())
    return 0


def references(words: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Returns the reference returns of environments.

    Raises:
        ValueError: for a word that is not ENV=LOW,HIGH.

    >>> references(["CartPole-v1=22,500"])
    {'CartPole-v1': (22.0, 500.0)}
    """
    found = {}
    for word in words:
        env, _, values = word.rpartition("=")
        try:
            low, high = map(float, values.split(","))
        except ValueError:
            raise ValueError(f"--reference {word!r} must be ENV=LOW,HIGH, such as CartPole-v1=22,500") from None
        found[env] = low, high
    return found


def row_of(group: Group) -> list[str]:
    """Returns the cells of a group."""
    value, low, high = map(number, group.score)
    reached = f"{number(group.reached[1])} ({group.reached[0]} of {len(group.runs)})"
    cells = [group.label, group.env_id, str(len(group.runs)), value, f"{low} to {high}"]
    return [*cells, number(group.mean), number(group.median), reached]


def show(comparison: Comparison) -> None:
    """Prints the tables and the notes."""
    from rich.console import Console
    from rich.markup import escape

    head = [
        "group",
        "environment",
        "runs",
        "IQM",
        "95 % interval",
        "mean",
        "median",
        f"{comparison.axis} to\nthreshold",
    ]
    tables.show(head, map(row_of, comparison.groups), 2)
    console = Console(highlight=False)
    console.print(comparison.definition, soft_wrap=True)
    levels = {group.env_id or "an unknown environment": number(group.reached[2]) for group in comparison.groups}
    console.print(
        f"threshold: {', '.join(f'{level} on {escape(env)}' for env, level in levels.items())}",
        soft_wrap=True,
    )
    for one in comparison.improvements:
        better, other, env, text = map(escape, improvement_row(one))
        console.print(f"{better} scores higher than {other} on {env} with probability {text}", soft_wrap=True)
    for note in comparison.notes:
        console.print(f"note: {escape(note)}", soft_wrap=True)
