"""The progress of a sweep: bars on a terminal, and lines where there is none."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING

from rejeu.experiments.coordinator import Coordinator, count
from rejeu.experiments.folder import JobProgress
from rejeu.experiments.jobs import again
from rejeu.reporting import notebook
from rejeu.reporting.formatting import counted
from rejeu.runs.values import quoted

if TYPE_CHECKING:
    from rich.progress import Progress

REFRESH, LINES = 2.0, 30.0
"""Seconds between two readings of the tables of the runs: for bars on a terminal, and for lines elsewhere."""
MAX_NAMED = 4
"""Most runs that are named in a line."""

echo = partial(print, flush=True)
Watch = Callable[[Coordinator], None]


@contextmanager
def shown(progress: bool = True) -> Iterator[tuple[Watch, Callable[[str], None]]]:
    """Context in which progress is shown; returns a function to call often, and one to call with each event."""
    console = notebook.console()
    if not progress:
        yield (lambda coordinator: None), (lambda text: None)
    elif not console.is_terminal:
        yield seldom(lambda coordinator: echo(line(coordinator)), LINES, time.monotonic() + LINES), echo
    else:
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[text]}"),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=console, speed_estimate_period=600) as bars:
            bars.add_task("all steps", total=None, text="")
            say = partial(console.print, highlight=False, markup=False)
            yield seldom(partial(draw, bars), REFRESH), say


def seldom(function: Watch, seconds: float, begin: float = 0.0) -> Watch:
    """Returns a function that calls another if the last call was so many seconds ago, and runs train."""
    due = begin

    def call(coordinator: Coordinator) -> None:
        nonlocal due
        if time.monotonic() >= due and coordinator.running():
            due = time.monotonic() + seconds
            function(coordinator)

    return call


def draw(bars: Progress, coordinator: Coordinator) -> None:
    """Draws a bar for each run that trains, and one for all steps of the sweep, by which the remaining time is estimated."""
    running = {job.name: job for job in coordinator.running()}
    of_runs = {task.description: task.id for task in bars.tasks[1:]}
    for name in of_runs.keys() - running.keys():
        bars.remove_task(of_runs[name])
    taken = 0
    for name, job in running.items():
        at = coordinator.folder.progress(job)
        taken += at.step
        task = of_runs[name] if name in of_runs else bars.add_task(name, text="")
        bars.update(task, total=job.run.steps, completed=at.step, text=text_of(at, job.run.steps))
    outcomes = coordinator.outcomes()
    asked = [one.job.run.steps or 0 for one in outcomes if one.state != "failed"]
    taken += sum(one.job.run.steps or 0 for one in outcomes if one.state == "done")
    bars.update(bars.tasks[0].id, total=sum(asked) or None, completed=taken, text=states(coordinator))


def line(coordinator: Coordinator) -> str:
    """Returns one line: the steps and the return of the runs that train, and how many are in each state."""
    jobs = coordinator.running()[:MAX_NAMED]
    parts = [f"{job.name} {text_of(coordinator.folder.progress(job), job.run.steps)}" for job in jobs]
    return "; ".join([*parts, states(coordinator)])


def text_of(progress: JobProgress, steps: int | None) -> str:
    """Returns how far a run is.

    >>> text_of(JobProgress(1500, mean_return=12.5), 20000)
    '1,500 of 20,000 steps, return 12.50'
    """
    asked = f" of {steps:,}" if steps else ""
    values = {"return": progress.mean_return, "best evaluation": progress.best}
    known = [f", {name} {value:,.2f}" for name, value in values.items() if math.isfinite(value)]
    return f"{progress.step:,}{asked} steps{''.join(known)}"


def states(coordinator: Coordinator) -> str:
    """Returns how many runs are in each state, such as ``2 running, 3 done``."""
    found = count(one.state for one in coordinator.outcomes())
    return ", ".join(f"{number} {state}" for state, number in found.items() if number)


def closing_lines(coordinator: Coordinator) -> list[str]:
    """Returns the lines that are printed at the end: how many jobs are in each state, and how failed ones are repeated."""
    folder, outcomes = coordinator.folder, coordinator.outcomes()
    lines = [f"{counted(len(outcomes), 'run')}: {states(coordinator)}"]
    if any(one.state == "failed" for one in outcomes) and not coordinator.running():
        resume = f"rejeu resume {quoted(folder.path)}{again(folder.jobs, coordinator.typed)}"
        lines.append(f"{resume} tries failed runs again")
    return lines
