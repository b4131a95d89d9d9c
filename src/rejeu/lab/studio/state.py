"""What all pages show: the runs below a folder, read again while they change."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from types import TracebackType

from rejeu.lab.cli.commands import RunOptions
from rejeu.lab.cli.environment import Environment
from rejeu.lab.reporting.rows import Row, Rows
from rejeu.lab.reporting.runs import RunSummary, is_file
from rejeu.lab.runs.config import EnvironmentOptions, RunConfig

EVERY = 1.0
"""Seconds between two looks at the folder, and longest look, after which rows are shown though some runs are not read yet."""


class Studio:
    """The folder of a studio, and the rows of its runs; a thread reads them while the context is entered."""

    def __init__(self, folder: Path, guests: Mapping[str, tuple[Path, Environment]] | None = None) -> None:
        self.folder = folder
        self.guests = dict(guests or {})
        """Models that the command line named, with their environments; they may be elsewhere."""
        self.rows: list[Row] = []
        """One a run, as :meth:`rejeu.lab.reporting.rows.Rows.read` returns them. Replaced when they change, never changed."""
        self.summaries: Mapping[str, RunSummary] = {}
        """The runs without their tables, by the names of their rows."""
        self.version = 0
        """Rises when the rows change."""
        self._reader = Rows(folder)
        self._trusted: dict[str, RunOptions] = {}
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

    def given(self, run: str) -> RunOptions:
        """Returns what people have typed about the environment of a run, which no file may let import code."""
        known = self.summaries.get(run)
        return self.typed("" if known is None else known.config.typed)

    def typed(self, env: str) -> RunOptions:
        """Returns what people have typed about an environment that they named like this."""
        return self._trusted.get(env, RunOptions())

    def trust(self, run: RunConfig) -> None:
        """Lets runs on an environment that somebody has typed be shown, though it is imported."""
        made = {one.name: getattr(run, one.name) for one in fields(EnvironmentOptions)}
        self._trusted[run.typed] = RunOptions(env=run.typed, **made)

    def holds(self, run: str) -> bool:
        """Returns whether a run has begun, by its path below the folder."""
        return self.row(run) is not None or any(row["run"].startswith(f"{run}/") for row in self.rows)

    def file(self, run: str, name: str) -> Path | None:
        """Returns a regular file in the folder of a run; None if there is none, or it is a symbolic link."""
        row = self.row(run)
        path = None if row is None else Path(row["path"]) / name
        return path if path is not None and is_file(path) else None

    def _follow(self) -> None:
        while not self._ended.is_set():
            rows = self._reader.read(EVERY)
            if rows != self.rows or not self.version:  # an empty folder was read too
                self.rows, self.summaries = rows, self._reader.summaries()
                self.version += 1
            self._ended.wait(EVERY)
