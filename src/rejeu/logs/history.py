"""The training history: one row per episode, with a summary and a plot."""

from __future__ import annotations

import csv
import io
import math
from array import array
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rejeu.core import atomic
from rejeu.core.types import JsonObject
from rejeu.core.validation import as_path, whole
from rejeu.logs.evaluation import Evaluation
from rejeu.logs.formatting import aligned, counted, html_table
from rejeu.training.run import Episode

if TYPE_CHECKING:
    from rejeu.logs.plots.picture import Picture

LAST_EPISODES = 20
"""Number of episodes that ``repr`` averages."""
COLUMNS = ("step", "env", "return", "length", "success", "seconds")


class History:
    """A table of episodes, 48 bytes each."""

    def __init__(self, episodes: Iterable[Episode] = ()) -> None:
        self._values = array("d")
        self._records = array("q")
        """Rows of the episodes with a higher return than all before them."""
        self.best_return = -math.inf
        """The highest return of an episode, minus infinity before the first."""
        for episode in episodes:
            self.append(episode)

    def __len__(self) -> int:
        return len(self._values) // len(COLUMNS)

    def __getitem__(self, column: str) -> np.ndarray:
        """Returns a column, ``(n_episodes,)``: step, env, return, length, success or seconds.

        Raises:
            KeyError: for another name.
        """
        if column not in COLUMNS:
            raise KeyError(f"{column!r} is not a column; expected one of {', '.join(COLUMNS)}")
        return np.array(self._values[COLUMNS.index(column) :: len(COLUMNS)], np.float64)

    def __repr__(self) -> str:
        n = min(len(self), LAST_EPISODES)
        if not n:
            return "<History: no episodes>"
        means = self.summary(LAST_EPISODES).last
        text = f"return {means.mean_return:,.2f}, length {means.mean_length:,.1f}"
        if math.isfinite(means.success_rate):
            text += f", success {means.success_rate:.0%}"
        steps = int(self["step"][-1])
        return f"<History: {counted(len(self), 'episode')} in {counted(steps, 'step')}; mean of the last {n}: {text}>"

    def _repr_html_(self) -> str:
        """Returns a table for notebooks."""
        return self.summary().to_html()

    @property
    def episodes(self) -> list[Episode]:
        """All episodes, oldest first; a new list."""
        return self.last(len(self))

    def last(self, n: int) -> list[Episode]:
        """Returns the last ``n`` episodes, or all if there are fewer, oldest first."""
        return [self._episode(row) for row in range(max(len(self) - n, 0), len(self))]

    def records(self) -> list[Episode]:
        """Returns the episodes with a higher return than all before them, oldest first, including the first episode.

        >>> history = History(Episode(10 * i, 0, value, 10, math.nan, i) for i, value in enumerate([1.0, 5.0, 5.0, 7.0]))
        >>> [episode.episode_return for episode in history.records()]
        [1.0, 5.0, 7.0]
        """
        return [self._episode(row) for row in self._records]

    @property
    def record_rows(self) -> np.ndarray:
        """Rows of :meth:`records` in the table, ``int64 (n_records,)``."""
        return np.array(self._records, np.int64)

    def _episode(self, row: int) -> Episode:
        width = len(COLUMNS)
        step, env, value, length, success, seconds = self._values[row * width : (row + 1) * width]
        return Episode(int(step), int(env), value, int(length), success, seconds)

    def summary(self, window: int = 100) -> Summary:
        """Returns a summary over all episodes and over the last ``window``; ``print`` shows it as a table.

        Raises:
            ValueError: if ``window`` is below 1.
        """
        return Summary.of(self, whole("window", window, least=1))

    def append(self, episode: Episode) -> None:
        """Appends an episode."""
        if episode.episode_return > self.best_return:
            self.best_return = episode.episode_return
            self._records.append(len(self))
        self._values.extend(episode)

    def table(self) -> np.ndarray:
        """Returns the table as an array, ``float64 (n_episodes, 6)``, with the columns ``COLUMNS``."""
        return np.array(self._values, np.float64).reshape(-1, len(COLUMNS))

    def replace(self, table: np.ndarray) -> None:
        """Replaces all episodes by those of a table, as :meth:`table` returns it.

        Raises:
            ValueError: if the table is invalid.
        """
        if table.dtype != np.float64 or table.shape[1:] != (len(COLUMNS),):
            raise ValueError(f"a history must be float64[n, {len(COLUMNS)}], got {table.dtype}{list(table.shape)}")
        for column in ("step", "env", "length"):
            if not np.isfinite(table[:, COLUMNS.index(column)]).all():
                raise ValueError(f"the column {column!r} of a history must be finite")
        self._values = array("d", table.ravel())
        best = np.fmax.accumulate([-np.inf, *table[:, COLUMNS.index("return")]])
        self._records = array("q", np.flatnonzero(best[1:] > best[:-1]).tolist())
        self.best_return = float(best[-1])

    def moving_average(self, column: str = "return", window: int = 50) -> np.ndarray:
        """Returns the mean of each value and up to ``window - 1`` values before it, ignoring NaN, ``(n_episodes,)``."""
        values = self[column]
        is_known = np.isfinite(values)
        totals = np.cumsum([np.where(is_known, values, 0.0), is_known], axis=1)
        totals[:, window:] -= totals[:, :-window]
        return totals[0] / np.where(totals[1], totals[1], np.nan)

    def write_csv(self, path: str | Path) -> None:
        """Writes the table with a header line, atomically."""
        atomic.write(as_path(path), csv_lines([COLUMNS, *self.episodes]))

    def plot(self, path: str | Path | None = None, against: str = "step", window: int | None = None) -> Picture:
        """Returns a matplotlib figure of returns and, if known, success; notebooks display it.

        Args:
            path: file to write, in the format of its suffix; None for none.
            against: ``"step"`` or ``"seconds"``.
            window: episodes in the moving average; None for a fifth of the run, at least 3 and at most 50, or more in a run of
                more than 20,000 episodes.

        Raises:
            MissingExtra: if matplotlib is not installed.
        """
        from rejeu.logs import plots

        return plots.learning_curve(self, path, against, window)

    def to_dict(self) -> JsonObject:
        """Returns the columns as arrays, ready for ``pandas.DataFrame``."""
        return {column: self[column] for column in COLUMNS}


def csv_lines(rows: Iterable[Iterable[object]]) -> bytes:
    """Returns rows as lines of a CSV file."""
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    return text.getvalue().encode()


class EpisodeTable:
    """Appends new episodes to a CSV file whenever metrics are written, so that the file can be read during training. A sink.

    Args:
        history: returns the history.
        path: path of the file; the episodes so far are written at once.
    """

    def __init__(self, history: Callable[[], History], path: Path) -> None:
        self._history, self._path = history, path
        self._n_written = 0
        self._rewrite()

    def __str__(self) -> str:
        return str(self._path)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Appends the episodes since the last call; the metrics are not used.

        Raises:
            OSError: if writing fails; the file is not changed.
        """
        history = self._history()
        if len(history) < self._n_written:
            self._rewrite()
        elif new := history.last(len(history) - self._n_written):
            atomic.append(self._path, csv_lines(new))
            self._n_written += len(new)

    def close(self) -> None:
        """Does nothing, because rows are not buffered."""

    def _rewrite(self) -> None:
        history = self._history()
        history.write_csv(self._path)
        self._n_written = len(history)


@dataclass(frozen=True, repr=False)
class Summary:
    """Summary of a run; ``print`` and notebooks show it as a table."""

    steps: int
    """Environment steps at the end of the last episode."""
    seconds: float
    """Training time in seconds at the end of the last episode."""
    all: Evaluation
    """All episodes; see :class:`rejeu.Evaluation`."""
    last: Evaluation
    """The last ``window`` episodes, or all if there are fewer."""
    records: int
    """Number of episodes with a higher return than all before them."""
    best: Episode | None
    """The first episode with the highest return; None if there are no episodes."""

    @classmethod
    def of(cls, history: History, window: int) -> Summary:
        """Returns the summary of a history; see :meth:`History.summary`."""
        returns, lengths, successes = (history[column] for column in ("return", "length", "success"))
        records = history.records()
        return cls(
            steps=int(history["step"][-1]) if len(history) else 0,
            seconds=float(history["seconds"][-1]) if len(history) else 0.0,
            all=Evaluation(returns, lengths, successes),
            last=Evaluation(returns[-window:], lengths[-window:], successes[-window:]),
            records=len(records),
            best=records[-1] if records else None,
        )

    def _head(self) -> str:
        return f"{counted(self.all.n, 'episode')} in {counted(self.steps, 'step')}, {self.seconds:,.1f} s"

    def _rows(self) -> list[list[str]]:
        """Returns the table, with a row of headings."""
        parts = (self.all, self.last)
        spread = "{:,.2f} \N{PLUS-MINUS SIGN} {:,.2f}".format
        rows = [
            ["", "all", f"last {self.last.n:,}"],
            ["return", *(spread(quarter.mean_return, quarter.std_return) for quarter in parts)],
            ["length", *(spread(quarter.mean_length, quarter.std_length) for quarter in parts)],
        ]
        if not math.isnan(self.all.success_rate):
            rates = ("-" if math.isnan(quarter.success_rate) else f"{quarter.success_rate:.1%}" for quarter in parts)
            rows.append(["success", *rates])
        return rows

    def _best(self) -> str:
        if self.best is None:
            return ""
        return f"best return {self.best.episode_return:,.2f} at step {self.best.step:,} ({counted(self.records, 'record')})"

    def __repr__(self) -> str:
        if self.best is None:
            return self._head()
        return "\n".join([self._head(), aligned(self._rows(), gap="   "), self._best()])

    def _repr_html_(self) -> str:
        return self.to_html()

    def to_html(self) -> str:
        """Returns the table as HTML, as notebooks show it."""
        table = "" if self.best is None else html_table(self._rows()) + f"<p>{self._best()}</p>"
        return f"<p>{self._head()}</p>{table}"
