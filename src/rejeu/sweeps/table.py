"""The live table of a sweep, and lines where there is no terminal."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING

from rejeu.reporting import notebook
from rejeu.reporting.text import counted
from rejeu.sweeps.coordinator import Coordinator, Outcome, count
from rejeu.sweeps.folder import JobProgress, SweepFolder

if TYPE_CHECKING:
    from rich.table import Table

REFRESH = 2.0
"""Seconds between two readings of the tables of the runs."""
MAX_ROWS = 30
"""Most runs that are listed."""

echo = partial(print, flush=True)
Watch = Callable[[Coordinator], None]


@contextmanager
def shown(folder: SweepFolder, progress: bool = True) -> Iterator[tuple[Watch, Callable[[str], None]]]:
    """Context in which progress is shown; returns a function to call often, and one to call with each event."""
    from rich.live import Live

    console = notebook.console()
    if not progress:
        yield (lambda coordinator: None), (lambda text: None)
    elif not console.is_terminal:
        yield (lambda coordinator: None), echo
    else:
        with Live(console=console, auto_refresh=False) as live:
            display = Display(folder)

            def watch(coordinator: Coordinator) -> None:
                if display.is_due(coordinator):
                    live.update(display.table(coordinator), refresh=True)

            yield watch, lambda text: console.print(text, highlight=False, markup=False)


class Display:
    """What the table remembers between two refreshes. Mutable."""

    def __init__(self, folder: SweepFolder) -> None:
        self.folder = folder
        self.finished: dict[str, JobProgress] = {}
        self._next = 0.0
        self._n_running = -1

    def is_due(self, coordinator: Coordinator) -> bool:
        """Returns whether the table is out of date."""
        now = time.monotonic()
        n_running = len(coordinator.running)
        if now < self._next and n_running == self._n_running:
            return False
        self._next, self._n_running = now + REFRESH, n_running
        return True

    def table(self, coordinator: Coordinator) -> Table:
        """Returns the running jobs, how many are in each state, the best result and the remaining time."""
        from rich import box
        from rich.table import Table

        outcomes = coordinator.outcomes()
        running = {attempt.job.name: self.folder.progress(attempt.job) for attempt in coordinator.running}
        for one in outcomes:
            if one.state == "done" and one.job.name not in self.finished:
                self.finished[one.job.name] = self.folder.progress(one.job)
        found = Table(
            box=box.SIMPLE, title=str(self.folder.path), caption=summary(coordinator, outcomes, running, self.finished)
        )
        for name in ("run", "state", "steps", "training return", "best evaluation"):
            found.add_column(name, justify="left" if name in ("run", "state") else "right")
        order = {"running": 0, "failed": 1, "stopped": 2, "done": 3, "waiting": 4}
        for one in sorted(outcomes, key=lambda one: order[one.state])[:MAX_ROWS]:
            progress = running.get(one.job.name) or self.finished.get(one.job.name) or JobProgress()
            asked = one.job.options.steps
            steps = f"{progress.step:,}" + (f" of {asked:,}" if asked else "")
            found.add_row(one.job.name, one.state, steps, number(progress.mean_return), number(progress.best))
        return found


def summary(
    coordinator: Coordinator, outcomes: list[Outcome], running: dict[str, JobProgress], finished: dict[str, JobProgress]
) -> str:
    """Returns one line: the number of jobs in each state, the best result of each environment, the remaining time."""
    states = count(one.state for one in outcomes)
    parts = [f"{number} {state}" for state, number in states.items() if number]
    best: dict[str, tuple[float, str]] = {}
    for one in outcomes:
        progress = running.get(one.job.name) or finished.get(one.job.name)
        if progress is not None and math.isfinite(progress.best):
            best[one.job.env] = max(best.get(one.job.env, (-math.inf, "")), (progress.best, one.job.name))
    parts += [f"best {value:,.2f} ({name})" for value, name in list(best.values())[:3]]
    left = remaining(coordinator, outcomes, running, finished)
    return ", ".join([*parts, f"about {duration(left)} left"] if math.isfinite(left) else parts)


def remaining(
    coordinator: Coordinator, outcomes: list[Outcome], running: dict[str, JobProgress], finished: dict[str, JobProgress]
) -> float:
    """Returns the seconds that the sweep still takes, from the mean time of a step so far; NaN if that is not known.

    Runs of different lengths are compared by their steps. Starting a run is not counted.
    """
    known = [one for one in [*running.values(), *finished.values()] if one.step and math.isfinite(one.seconds)]
    steps, seconds = sum(one.step for one in known), sum(one.seconds for one in known)
    if not steps or not coordinator.launcher.capacity:
        return math.nan
    asked = [one.job.options.steps for one in outcomes if one.state not in ("done", "failed")]
    if any(one is None for one in asked):
        return math.nan
    left = sum(one or 0 for one in asked) - sum(one.step for one in running.values())
    return max(left, 0) * seconds / steps / min(coordinator.launcher.capacity, max(len(asked), 1))


def duration(seconds: float) -> str:
    """Returns a length of time as text.

    >>> duration(42), duration(4000)
    ('42 s', '1 h 7 min')
    """
    if seconds < 100:
        return f"{seconds:.0f} s"
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


def number(value: float) -> str:
    """Returns a number as text, ``-`` for NaN."""
    return f"{value:,.2f}" if math.isfinite(value) else "-"


def closing_lines(coordinator: Coordinator) -> list[str]:
    """Returns the lines that are printed at the end: how many jobs are in each state, and why some failed."""
    outcomes = coordinator.outcomes()
    states = count(one.state for one in outcomes)
    text = ", ".join(f"{number} {state}" for state, number in states.items() if number)
    return [f"{counted(len(outcomes), 'run')}: {text}"]
