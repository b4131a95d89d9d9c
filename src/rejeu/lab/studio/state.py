"""The runs below a folder, read again while they change; all pages show them."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path, PurePath

from rejeu.envs.registry import are_plain, is_plain_id
from rejeu.lab.reporting.rows import Row, RowReader
from rejeu.lab.runs.arguments import RunOptions
from rejeu.lab.runs.config import RunConfig, written
from rejeu.lab.runs.environment import Environment
from rejeu.lab.runs.read import RunSummary, is_file

EVERY = 1.0
"""Seconds between two looks at the folder, and longest look, after which rows are shown though some runs are not read yet."""
REST = 3.0
"""Rest between two looks at many runs, as a multiple of the time that the last one took."""

Guests = Mapping[str, tuple[Path, Environment]]
NOTHING = RunConfig(env="")
"""Description of a run for which nobody has named an environment or a module."""


def is_below(path: PurePath) -> bool:
    """Returns whether a path stays below the folder that it is joined to, on the system of its class."""
    return bool(path.parts) and not path.anchor and ".." not in path.parts and "\0" not in str(path)


class Studio:
    """The folder of a studio, and the rows of its runs; a thread reads them while the context is entered."""

    def __init__(self, folder: Path, guests: Guests | None = None, typed: RunConfig = NOTHING) -> None:
        self.folder, self.imports = folder, typed.imports
        self.guests = dict(guests or {})
        """Models that the command line named, with their environments; they may be elsewhere."""
        self.rows: list[Row] = []
        """One a run, of :meth:`rejeu.lab.reporting.rows.RowReader.read`. Replaced when they change, never changed."""
        self.summaries: Mapping[str, RunSummary] = {}
        """The runs without their tables, by the names of their rows."""
        self.version = 0
        """Rises when the rows change."""
        self.deleted: list[Path] = []
        """Folders in the bin, which come back in the reverse order."""
        self._reader = RowReader(folder)
        self._trusted = [typed]
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._follow, daemon=True)

    def __enter__(self) -> Studio:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()

    def below(self, name: str) -> Path:
        """Returns the path of a name below the folder.

        Raises:
            ValueError: if it is elsewhere, also by a symbolic link.
        """
        path = self.folder / name
        if not is_below(Path(name)) or not path.resolve().is_relative_to(self.folder.resolve()):
            raise ValueError(
                f"{name!r} is not in the folder of the studio; it must be a name of a folder below {self.folder}"
            )
        return path

    def row(self, run: str) -> Row | None:
        """Returns the row of a run by its path below the folder, as pages have it in their address; None if there is none."""
        return next((row for row in self.rows if row.run == run), None)

    def given(self, run: str) -> RunOptions:
        """Returns how the environment of a run is made, as far as people have typed what no file may name.

        All that makes the environment of a run gets this: threads that show it, and commands, by :meth:`words`. The numbers
        and words that the environment takes are those of the run.
        """
        config = NOTHING if (summary := self.summaries.get(run)) is None else summary.config
        closest = sorted(self._trusted, key=lambda typed: written(typed.env_kwargs) != written(config.env_kwargs))
        options = (allowed(typed, config) for typed in closest)
        return self._with_imports(next(filter(None, options), RunOptions()))

    def words(self, run: str) -> list[str]:
        """Returns the options of :meth:`given` as words of a command line."""
        options = self.given(run)
        return options.as_words(*(() if options.env is None else ("--env", options.env)))

    def typed(self, env: str) -> RunOptions:
        """Returns the options typed for an environment that people named like this, or on the command line by its id."""
        options = (
            RunOptions(env=run.typed, env_kwargs=run.env_kwargs, wrappers=run.wrappers, imports=run.imports)
            for i, run in enumerate(self._trusted)  # the first is of the command line
            if env and env in (run.env, run.typed) and (i == 0 or not is_plain_id(env))
        )
        return self._with_imports(next(options, RunOptions()))

    def trust(self, run: RunConfig) -> None:
        """Lets runs be shown and go on whose environment is imported as that of this run, which somebody has typed."""
        self._trusted.append(run)

    def _with_imports(self, options: RunOptions) -> RunOptions:
        return replace(options, imports=(*dict.fromkeys((*self.imports, *options.imports)),))

    def holds(self, run: str) -> bool:
        """Returns whether a run has begun, by its path below the folder."""
        return any(f"{row.run}/".startswith(f"{run}/") for row in self.rows if row.state != "gone")

    def file(self, run: str, name: str) -> Path | None:
        """Returns a regular file in the folder of a run; None if there is none, or it is a symbolic link."""
        row = self.row(run)
        path = None if row is None else Path(row.path) / name
        return path if path is not None and is_file(path) else None

    def forget(self, path: Path) -> None:
        """Leaves out the row of a run that was moved away."""
        self._reader.moved.add(path)
        self.rows = [row for row in self.rows if row.path != path]
        self.version += 1

    def _follow(self) -> None:
        while not self._ended.is_set():
            began = time.monotonic()
            rows = self._reader.read(EVERY)
            if rows != self.rows or not self.version:  # an empty folder was read too
                self.rows, self.summaries = rows, self._reader.summaries()
                self.version += 1
            is_complete = all(row.state != "unread" for row in rows)
            self._ended.wait(max(EVERY, REST * (time.monotonic() - began)) if is_complete else 0.0)


def allowed(typed: RunConfig, run: RunConfig) -> RunOptions | None:
    """Returns how the environment of a run is made, None unless somebody has typed all of it that no file may name."""
    fits = run.env and (run.typed == typed.typed or run.env == typed.env or (not typed.env and is_plain_id(run.typed)))
    plain = {name: value for name, value in run.env_kwargs.items() if are_plain({name: value})}
    kwargs = {name: plain.get(name, typed.env_kwargs.get(name)) for name in run.env_kwargs}
    is_typed = {*run.wrappers} <= {*typed.wrappers} and run.env_kwargs.keys() - plain.keys() <= typed.env_kwargs.keys()
    if not (fits and is_typed and are_plain(plain)):
        return None
    return RunOptions(env=typed.typed or run.typed, env_kwargs=kwargs, wrappers=run.wrappers, imports=typed.imports)
