"""``rejeu sweep``: many runs from a plan, and the comparison of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rejeu.cli import jsonout
from rejeu.cli.commands import Resume, Sweep
from rejeu.errors import MissingExtra
from rejeu.interrupt import NAMES, Interrupt
from rejeu.reporting.comparison import By, Comparison, compare
from rejeu.reporting.tabular import interval_text
from rejeu.reporting.text import quoted
from rejeu.sweeps.coordinator import Coordinator
from rejeu.sweeps.folder import SweepFolder, read_folder
from rejeu.sweeps.jobs import Code, again
from rejeu.sweeps.sweep import SweepResult, make_launcher, prepare
from rejeu.sweeps.table import closing_lines, echo, shown


def run(arguments: Sweep) -> int:
    """Trains and returns the exit status: 0, 2 if a run failed, 130 after Ctrl-C and 143 after SIGTERM."""
    return jsonout.run(begin, arguments)


def begin(arguments: Sweep) -> tuple[int, dict[str, Any]]:
    """Begins or joins a sweep; returns the exit status and the result."""
    code = Code(imports=arguments.imports)
    folder = prepare(arguments.plan, arguments.out, arguments.workers, code, arguments.ray)
    return complete(folder, code, arguments.workers, arguments.ray, retry=False)


def resume(arguments: Resume) -> tuple[int, dict[str, Any]]:
    """Completes the sweep in a folder, failed runs included; returns the exit status and the result.

    Raises:
        ValueError: for options that only a single run has.
    """
    if arguments.steps is not None or arguments.minutes is not None:
        raise ValueError(
            f"{arguments.run} is a sweep, which trains to its goals; --steps and --minutes are for a single run"
        )
    code = Code(env=arguments.env, wrappers=arguments.wrapper, imports=arguments.imports)
    folder = read_folder(arguments.run, code)
    return complete(folder, code, arguments.workers, arguments.ray, retry=True)


def complete(
    folder: SweepFolder, code: Code, workers: int | None, ray: str | None, retry: bool
) -> tuple[int, dict[str, Any]]:
    """Trains what is missing in a folder, compares the runs, and returns the exit status and the result."""
    with Interrupt() as stop:
        launcher = make_launcher(folder, workers, ray)
        echo(f"sweep         {folder.path}, {len(folder.jobs)} runs, {launcher.capacity} at once")
        with shown(folder) as (watch, say):
            coordinator = Coordinator(folder, launcher, stop, code, retry, say)
            coordinator.run(watch)
    for line in closing_lines(coordinator):
        echo(line)
    comparison = summarize(folder.path, "setting" if len({job.setting for job in folder.jobs}) > 1 else None)
    result = SweepResult(folder.path, tuple(coordinator.outcomes()))
    content = {
        "folder": folder.path,
        **result.counts(),
        "runs": result.table(),
        "comparison": None if comparison is None else comparison.table(),
    }
    if stop.signal is not None:
        echo(f"stopped by {NAMES[stop.signal]}; rejeu resume {quoted(folder.path)}{again(folder.jobs, code)} continues")
        return 128 + stop.signal, content
    return (2 if result.failed else 0), content


def summarize(folder: Path, by: By | None = None) -> Comparison | None:
    """Writes ``compare.html`` and prints the scores with their intervals, or why there are none; returns the comparison."""
    try:
        comparison = compare(folder, by)
    except (ValueError, FileNotFoundError) as error:
        echo(f"no comparison: {error}")
        return None
    for group in comparison.groups:
        echo(f"{group.label} on {group.env_id}: {interval_text(group)}")
    echo(comparison.definition)
    for note in comparison.notes:
        echo(f"note: {note}")
    try:
        echo(f"comparison    {comparison.save(folder / 'compare.html')[0]}")
    except (MissingExtra, OSError) as error:
        echo(f"no compare.html: {error}; rejeu compare {quoted(folder)} --out compare.md writes the tables")
    return comparison
