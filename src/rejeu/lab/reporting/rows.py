"""Rows of a table of runs, the same in a terminal, as JSON and in the studio. A run is read again if a file has changed."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core.records import shown, utf8
from rejeu.lab.reporting import run_list
from rejeu.lab.runs.read import Remarks, RunSummary, best_row, is_file, is_locked
from rejeu.logs import charts
from rejeu.logs.formatting import duration
from rejeu.logs.tables import EMPTY

WINDOW = 100
"""Training episodes in the mean that is shown."""
POINTS = 40
"""Points of the small curve."""
COLUMNS = ("run", "environment", "algorithm", "state", "steps", "best", "rate", "curve")
"""Titles of a table, in the order of :func:`cells`."""
N_TEXT = 3
"""First columns that are text, and that a narrow terminal folds."""
BARS = "▁▂▃▄▅▆▇█"
SHARE = 20.0
"""A run whose reading takes a second is read at most once in so many seconds, ..."""
LONGEST = 10.0
"""... up to this."""
SLICE = 64
"""Most files of another program's run whose times are looked at."""

OF_RUN = ("path", "name", "format", "state", "steps", "seconds", "warnings", "remarks")
"""Fields of a run that its row copies."""
BEGINS = "begins; functions are compiled, which takes up to a minute"
"""Note on a run that has not taken a step."""


@dataclass(frozen=True)
class BestEvaluation:
    """The best evaluation of a run, with the 95 % interval of its mean return."""

    step: int
    mean_return: float
    low: float
    high: float
    success_rate: float


@dataclass(frozen=True, kw_only=True)
class Row:
    """A run as a row of a table, as plain values."""

    run: str = ""
    """Path below the folder that is listed."""
    path: Path
    name: str
    format: str
    env: str
    algorithm: str | None
    seed: int | None
    state: str
    """As of :attr:`rejeu.lab.runs.read.RunSummary.state`, "unread" or "gone"."""
    steps: int
    steps_asked: int | None
    seconds: float
    steps_per_second: float
    seconds_left: float | None
    """Until its goal of steps or of time; None unless it runs."""
    episodes: int
    mean_return: float
    """Of the last :data:`WINDOW` training episodes."""
    best: BestEvaluation | None
    evaluations: int
    curve: list[float]
    changed: float
    """When a file of it was written last, in seconds since 1970."""
    pictures: tuple[str, ...]
    """Names of its files."""
    warnings: tuple[str, ...]
    remarks: Remarks
    """By a person."""
    notes: tuple[str, ...]
    """One for each thing that was missing or damaged, and the error that has ended it."""

    @property
    def share(self) -> float | None:
        """Share of its steps, or of its time, that is done; None unless it runs towards a goal."""
        if self.seconds_left is None:
            return None
        if self.steps_asked:
            return min(self.steps / self.steps_asked, 1.0)
        total = self.seconds + self.seconds_left
        return self.seconds / total if 0 < total < math.inf else None

    @property
    def reason(self) -> str:
        """Why it is in its state, as far as that is known: the error that has ended it, or that it compiles."""
        if self.state == "running":
            return "" if self.steps else BEGINS
        return next(iter(self.notes), "") if self.state in ("damaged", "gone", "crashed") else ""


@dataclass
class Known:
    """A run as it was read last. Mutable."""

    stamp: object
    row: Row
    run: RunSummary | None
    """Without its tables; None if it could not be read."""
    due: float
    """When it may be read again, by :func:`time.monotonic`."""


class RowReader:
    """The rows of all runs below a folder. Mutable; for one thread."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.moved: set[Path] = set()
        """Runs that somebody has moved away, which have no row while they are not there. Other threads may add to it."""
        self._known: dict[Path, Known] = {}

    def read(self, seconds: float = math.inf) -> list[Row]:
        """Returns one row a run, in the order of their paths; also of those that are damaged, or have disappeared since.

        Args:
            seconds: time after which further runs are left to the next call; their state is then "unread" or as it was.
        """
        until = time.monotonic() + seconds
        try:
            paths = run_list.find(self.folder)
        except OSError:  # it is not there, or not any more
            paths = []
        self.moved -= {*paths}
        for path in self._known.keys() - {*paths}:
            if path in self.moved:
                del self._known[path]
                continue
            row = replace(self._known[path].row, state="gone", notes=("its folder is no longer there",))
            self._known[path] = Known(None, row, None, 0.0)
        for path in paths:
            if time.monotonic() < until:
                self._update(path)
            elif path not in self._known:
                self._known[path] = Known(None, nothing(path, "unread"), None, 0.0)
        return [replace(self._known[path].row, run=self.name_of(path)) for path in sorted(self._known)]

    def row(self, path: Path) -> Row:
        """Returns the row of one run."""
        self._update(path)
        return self._known[path].row

    def name_of(self, path: Path) -> str:
        """Returns the path of a run below the folder, which names it; what is not UTF-8 in it is escaped."""
        return utf8(path.relative_to(self.folder).as_posix() if path != self.folder else path.name)

    def summaries(self) -> Mapping[str, RunSummary]:
        """Returns the runs that could be read, without their tables, by the names of their rows."""
        return {self.name_of(path): entry.run for path, entry in self._known.items() if entry.run is not None}

    def _update(self, path: Path) -> None:
        previous, began = self._known.get(path), time.monotonic()
        current = stamp(path)
        if previous is not None and (previous.stamp == current or began < previous.due):
            return
        run: RunSummary | None = None
        try:
            if utf8(inner := str(path).removeprefix(str(self.folder))) != inner:
                raise ValueError("its name is not UTF-8; rename the folder")
            run = run_list.read(path, table_only=True)
            row = describe(run)
            run = replace(run, episodes=EMPTY, evaluations=EMPTY, metrics=EMPTY, goals=EMPTY, replays=EMPTY)
        except Exception as error:  # files can hold anything, and one run may not hide the others
            row = replace(nothing(path, "damaged"), notes=(shown(str(error) or repr(error), 300),))
        now = time.monotonic()
        self._known[path] = Known(current, row, run, now + min(SHARE * (now - began), LONGEST))


def stamp(path: Path) -> object:
    """Returns a value that changes when a run does: times and sizes of its files, and whether a process trains it."""
    watched = files(path) if run_list.is_ours(path) else others(path)
    return is_locked(RunFolder(path).lock), *map(time_of, watched)


def files(path: Path) -> tuple[Path, ...]:
    """Returns the files of a run that say that it has changed."""
    run = RunFolder(path)
    return *run.marks, run.evaluations, run.warnings, run.remarks, run.agent, run.checkpoints, run.paused, run.video


def others(path: Path) -> Iterator[Path]:
    """Yields a file, or the first files of a folder, of another program's run."""
    with suppress(OSError), os.scandir(path) as inside:
        yield from (Path(entry.path) for entry, _ in zip(inside, range(SLICE), strict=False))
    yield path


def time_of(path: Path) -> tuple[int, int] | None:
    """Returns time and size of a file, None if it does not exist."""
    try:
        status = path.lstat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size


def nothing(path: Path, state: Literal["unread", "damaged"]) -> Row:
    """Returns the row of a run of which nothing is known but its state."""
    return replace(describe(RunSummary(path=path, name=shown(path.name, 200))), state=state)


def describe(run: RunSummary) -> Row:
    """Returns the row of a run, as plain values."""
    rate, config = run.steps_per_second, run.config
    seconds_left = max(config.steps - run.steps, 0) / rate if config.steps and rate else math.nan
    if config.minutes is not None:
        seconds_left = max(60 * config.minutes - run.stepping_seconds, 0.0)
    returns = run.episodes.column("return")[-WINDOW:]
    means = run.metrics.column("rollout/ep_rew_mean")
    folder = RunFolder(run.path)
    recent = returns if len(returns) else means[np.isfinite(means)][-1:]
    return Row(
        **{name: getattr(run, name) for name in OF_RUN},
        env=config.env,
        algorithm=config.algorithm,
        seed=config.seed,
        steps_asked=config.steps,
        steps_per_second=rate,
        seconds_left=seconds_left if run.state == "running" else None,
        episodes=len(run.episodes),
        mean_return=float(np.mean(recent[np.isfinite(recent)])) if np.isfinite(recent).any() else math.nan,
        best=best_evaluation(run),
        evaluations=len(run.evaluations),
        curve=curve(run),
        changed=max((time_of(path) or (0, 0))[0] for path in files(run.path)) / 1e9,
        pictures=tuple(path.name for path in (folder.video, folder.curve) if is_file(path)),
        notes=(*filter(None, [run.error if run.state == "crashed" else ""]), *run.notes),
    )


def best_evaluation(run: RunSummary) -> BestEvaluation | None:
    """Returns the best evaluation; None if there is none."""
    row = best_row(run.evaluations)
    if row is None:
        return None
    step, value, success = (run.evaluations.column(name)[row] for name in ("step", "mean_return", "success_rate"))
    low, high = (float(end[row]) for end in charts.interval(run.evaluations, "return"))
    return BestEvaluation(int(step), float(value), low, high, float(success))


def curve(run: RunSummary) -> list[float]:
    """Returns the mean returns of up to :data:`POINTS` parts of the training; of a run without episodes, its evaluations."""
    values = run.episodes.column("return") if len(run.episodes) else run.evaluations.column("mean_return")
    values = values[charts.usable(values)]
    n = min(POINTS, len(values))
    return [float(f"{piece.mean():.4g}") for piece in np.array_split(values, n)] if n else []


def cells(row: Row) -> dict[str, str]:
    """Returns a row as texts, by the titles of :data:`COLUMNS`."""
    names = (row.run, row.env, row.algorithm, row.state)
    numbers = (steps_text(row), best_text(row), rate_text(row), bars(row.curve))
    return dict(zip(COLUMNS, (shown(text, 300) for text in (*names, *numbers)), strict=True))


def texts(row: Row) -> list[str]:
    """Returns a row as texts, in the order of :data:`COLUMNS`."""
    return [*cells(row).values()]


def steps_text(row: Row) -> str:
    """Returns the steps done, with those asked for unless all are done."""
    done, asked = row.steps, row.steps_asked
    return f"{done:,} of {asked:,} ({done / asked:.0%})" if asked and done < asked else f"{done:,}"


def best_text(row: Row) -> str:
    """Returns the best evaluation with its interval; of a run without one the mean return of the last training episodes."""
    best = row.best
    if best is None:
        return f"{row.mean_return:,.2f} in training" if math.isfinite(row.mean_return) else "-"
    interval = f" ({best.low:,.2f} to {best.high:,.2f})" if math.isfinite(best.low) else ""
    success = f", {best.success_rate:.0%} success" if math.isfinite(best.success_rate) else ""
    return f"{best.mean_return:,.2f}{interval}{success}"


def rate_text(row: Row) -> str:
    """Returns the steps a second, and the time that is left."""
    rate, seconds = row.steps_per_second, row.seconds_left
    remaining = "" if seconds is None or not math.isfinite(seconds) else f", {duration(round(seconds))} left"
    return f"{rate:,.0f}/s{remaining}" if math.isfinite(rate) else "-"


def bars(values: list[float]) -> str:
    """Returns a small curve as text.

    >>> bars([0.0, 1.0, 2.0, 4.0])
    '▁▃▅█'
    """
    low, high = min(values, default=0.0), max(values, default=0.0)
    scale = (len(BARS) - 1) / ((high - low) or 1.0)
    return "".join(BARS[round((value - low) * scale)] for value in values[:: max(len(values) // 10, 1)])
