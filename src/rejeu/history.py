"""The record of a training run: one row an episode, as data and as a picture."""

from __future__ import annotations

import csv
import io
from array import array
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rejeu import atomic
from rejeu.loops.host import Episode

if TYPE_CHECKING:
    from rejeu.figures import Picture

COLUMNS = ("step", "env", "return", "length", "success", "seconds")


class History:
    """A growing table of episodes, 48 bytes each."""

    def __init__(self, episodes: Iterable[Episode] = ()) -> None:
        self._values = array("d")
        for episode in episodes:
            self.append(episode)

    def __len__(self) -> int:
        return len(self._values) // len(COLUMNS)

    def __getitem__(self, column: str) -> np.ndarray:
        """Returns one column, ``(n_episodes,)``: step, env, return, length, success or seconds.

        Raises:
            KeyError: for another name.
        """
        if column not in COLUMNS:
            raise KeyError(f"{column!r} is no column; there are {', '.join(COLUMNS)}")
        return np.array(self._values[COLUMNS.index(column) :: len(COLUMNS)], np.float64)

    @property
    def episodes(self) -> list[Episode]:
        """All episodes, oldest first; a list made anew."""
        return self.last(len(self))

    def last(self, n: int) -> list[Episode]:
        """Returns the last ``n`` episodes, or all if there are fewer, oldest first."""
        width = len(COLUMNS)
        first = max(len(self) - n, 0)
        rows = [self._values[i : i + width] for i in range(first * width, len(self._values), width)]
        return [
            Episode(int(step), int(env), value, int(length), success, seconds)
            for step, env, value, length, success, seconds in rows
        ]

    def append(self, episode: Episode) -> None:
        """Adds one episode at the end."""
        self._values.extend(episode)

    def table(self) -> np.ndarray:
        """Returns everything as one array, ``float64 (n_episodes, 6)``, its columns in the order of ``COLUMNS``."""
        return np.array(self._values, np.float64).reshape(-1, len(COLUMNS))

    def replace(self, table: np.ndarray) -> None:
        """Puts what :meth:`table` returned in place of everything.

        Raises:
            ValueError: if it is no such table.
        """
        if table.dtype != np.float64 or table.shape[1:] != (len(COLUMNS),):
            raise ValueError(f"a history is float64[n, {len(COLUMNS)}], got {table.dtype}{list(table.shape)}")
        for column in ("step", "env", "length"):
            if not np.isfinite(table[:, COLUMNS.index(column)]).all():
                raise ValueError(f"the column {column!r} of a history must be finite")
        self._values = array("d", table.ravel())

    def moving_average(self, column: str = "return", window: int = 50) -> np.ndarray:
        """Returns the mean of each value and up to ``window - 1`` before it, NaN left out, ``(n_episodes,)``."""
        values = self[column]
        known = np.isfinite(values)
        sums = np.cumsum(np.where(known, values, 0.0))
        counts = np.cumsum(known)
        sums[window:] = sums[window:] - sums[:-window]
        counts[window:] = counts[window:] - counts[:-window]
        return sums / np.where(counts, counts, np.nan)

    def write_csv(self, path: str | Path) -> None:
        """Writes the table with a header line; an older file is replaced only once the new one is complete."""
        text = io.StringIO()
        writer = csv.writer(text)
        writer.writerow(COLUMNS)
        writer.writerows(self.episodes)
        with atomic.replacing(Path(path)) as file:
            file.write(text.getvalue().encode())

    def plot(self, path: str | Path | None = None, against: str = "step", window: int | None = None) -> Picture:
        """Returns a matplotlib figure of returns and, where known, success; a notebook shows it by itself.

        Args:
            path: of a file to write, whose suffix says the format; None for none.
            against: ``"step"`` or ``"seconds"``.
            window: episodes in the moving average; None: a fifth of the run, at least 3 and at most 50.

        Raises:
            MissingExtra: if matplotlib is not installed.
        """
        from rejeu import plots

        return plots.learning_curve(self, path, against, window)

    def to_dict(self) -> dict[str, Any]:
        """Returns the columns as arrays, ready for ``pandas.DataFrame``."""
        return {column: self[column] for column in COLUMNS}
