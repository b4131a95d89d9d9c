"""``rejeu sweep``: many runs from a plan, and the comparison of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rejeu.cli.commands import Resume, Sweep
from rejeu.errors import MissingExtra
from rejeu.experiments.folder import SweepFolder, read_folder
from rejeu.experiments.jobs import again
from rejeu.experiments.scheduler import Launcher
from rejeu.experiments.sweep import (
    Coordinator,
    Outcome,
    SweepResult,
    closing_lines,
    echo,
    make_launcher,
    prepare,
    shown,
)
from rejeu.interrupt import NAMES, Interrupt
from rejeu.reporting.comparison import By, Comparison, compare
from rejeu.runs.config import RunConfig
from rejeu.runs.values import quoted


def run_sweep(arguments: Sweep) -> tuple[int, dict[str, Any]]:
    """Begins or joins a sweep; the exit status is 0, 2 if a run failed, 1 if one was left, 130 or 143 after a signal."""
    typed = RunConfig(env="", imports=arguments.imports)
    folder = prepare(arguments.plan, arguments.out, arguments.workers, typed, arguments.ray)
    return complete(folder, typed, arguments.workers, arguments.ray, retry=False)


def resume(arguments: Resume) -> tuple[int, dict[str, Any]]:
    """Completes the sweep in a folder, failed runs included; returns the exit status and the result.

    Raises:
        ValueError: for options that only a single run has.
    """
    if arguments.steps is not None or arguments.minutes is not None:
        raise ValueError(
            f"{arguments.run} is a sweep, which trains to its goals; --steps and --minutes are for a single run"
        )
    given = {key: getattr(arguments, key) for key in ("env_kwargs", "wrappers", "imports")}
    typed = RunConfig(env=arguments.env or "", **given)
    return complete(read_folder(arguments.run, typed), typed, arguments.workers, arguments.ray, retry=True)


def complete(
    folder: SweepFolder, typed: RunConfig, workers: int | None, ray: str | None, retry: bool
) -> tuple[int, dict[str, Any]]:
    """Trains what is missing in a folder, compares the runs, and returns the exit status and the result."""
    launcher = make_launcher(folder, workers, ray)
    echo(f"sweep         {folder.path}, {len(folder.jobs)} runs, {launcher.capacity} at once")
    status, outcomes, comparison = train(folder, launcher, typed, retry)
    result = SweepResult(folder.path, tuple(outcomes))
    return status, {"folder": folder.path, **result.counts(), "runs": result.table(), "comparison": comparison}


def train(
    folder: SweepFolder, launcher: Launcher, typed: RunConfig, retry: bool = False, replaces: tuple[str, str] = ("", "")
) -> tuple[int, list[Outcome], list[dict[str, Any]] | None]:
    """Trains what is missing in a folder and compares the runs.

    Args:
        folder: of the runs.
        launcher: what starts them.
        typed: what the command line named for import.
        retry: whether failed runs are tried again.
        replaces: part of the names of runs, and what stands in its place in lines about them.

    Returns the exit status, the outcomes, and the rows of the comparison, None if there is none.
    """
    with Interrupt() as stop, shown() as (watch, say):
        coordinator = Coordinator(folder, launcher, stop, typed, retry, lambda text: say(text.replace(*replaces, 1)))
        coordinator.run(watch)
    for line in closing_lines(coordinator):
        echo(line)
    comparison = summarize(folder.path, "setting" if len({job.setting for job in folder.jobs}) > 1 else None)
    outcomes = coordinator.outcomes()
    states = {one.state for one in outcomes}
    status = 2 if "failed" in states else 1 if states & {"waiting", "stopped"} else 0
    if stop.signal is not None:
        echo(
            f"stopped by {NAMES[stop.signal]}; rejeu resume {quoted(folder.path)}{again(folder.jobs, typed)} continues"
        )
        status = 128 + stop.signal
    return status, outcomes, None if comparison is None else comparison.table()


def summarize(folder: Path, by: By | None = None) -> Comparison | None:
    """Writes ``compare.html`` and prints the scores with their intervals, or why there are none; returns the comparison."""
    try:
        comparison = compare(folder, by)
    except (ValueError, FileNotFoundError) as error:
        echo(f"no comparison: {error}")
        return None
    for group in comparison.groups:
        echo(f"{group.label} on {group.env_id}: {group.interval}")
    echo(comparison.definition)
    for note in comparison.notes:
        echo(f"note: {note}")
    try:
        echo(f"comparison    {comparison.save(folder / 'compare.html')[0]}")
    except (MissingExtra, OSError) as error:
        echo(f"no compare.html: {error}; rejeu compare {quoted(folder)} --out compare.md writes the tables")
    return comparison
