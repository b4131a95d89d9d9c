"""What all pages show: the runs below a folder, read again while they change."""

from __future__ import annotations

import threading
from pathlib import Path
from types import TracebackType

from rejeu.lab.reporting.rows import Row, Rows

EVERY = 1.0
"""Seconds between two looks at the folder, and longest look, after which rows are shown though some runs are not read yet."""


class Studio:
    """The folder of a studio, and the rows of its runs; a thread reads them while the context is entered."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.rows: list[Row] = []
        """One a run, as :meth:`rejeu.lab.reporting.rows.Rows.read` returns them. Replaced when they change, never changed."""
        self.version = 0
        """Rises when the rows change."""
        self._reader = Rows(folder)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._follow, daemon=True)

    def __enter__(self) -> Studio:
        self._thread.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._ended.set()

    def row(self, run: str) -> Row | None:
        """Returns the row of a run by its path below the folder, as pages have it in their address; None if there is none."""
        return next((row for row in self.rows if row["run"] == run), None)

    def _follow(self) -> None:
        while not self._ended.is_set():
            rows = self._reader.read(EVERY)
            if rows != self.rows:
                self.rows, self.version = rows, self.version + 1
            self._ended.wait(EVERY)
