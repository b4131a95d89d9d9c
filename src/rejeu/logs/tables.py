"""Tables of numbers in CSV files. The files are untrusted: sizes are bounded, damaged rows are left out."""

from __future__ import annotations

import csv
import io
import os
import stat
from array import array
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import IO, Any, AnyStr, BinaryIO

import numpy as np

from rejeu.core.records import shown
from rejeu.logs.formatting import counted

MAX_BYTES = 2**27
"""Upper limit on what is read of one table, in bytes."""
MAX_COLUMNS = 512
MAX_CELLS = 2**23
"""Upper limit on the cells of one table; a million episodes fit."""
MAX_LINE = 2**20
"""Upper limit on the bytes of a line."""
MEANS = ("success_rate", "mean_return", "std_return", "mean_length")
"""Columns of a table of evaluations that are attributes of :class:`rejeu.Evaluation`."""
HUGE = 1e100
"""Magnitude from which a return is taken for damage."""


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of numbers of the same length, and what was wrong with the file."""

    columns: dict[str, np.ndarray]
    """``float64 (n_rows,)`` by name; NaN where a cell is empty or not a number."""
    notes: tuple[str, ...] = ()
    """One line for each thing that was missing or damaged."""

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def column(self, name: str) -> np.ndarray:
        """Returns a column, NaN everywhere if the file lacks it."""
        return self.columns[name] if name in self.columns else np.full(len(self), np.nan)


EMPTY = Table({})


def evaluation_table(evaluations: Iterable[tuple[int, Any]], episodes: Table = EMPTY) -> Table:
    """Returns evaluations as the table of a run, at the times that training episodes ended at.

    Args:
        evaluations: steps and :class:`rejeu.Evaluation`.
        episodes: of training; without any the times are unknown.
    """
    pairs = list(evaluations)
    steps = np.array([step for step, _ in pairs], np.float64)
    results = [result for _, result in pairs]
    columns = {name: np.array([getattr(evaluated, name) for evaluated in results], np.float64) for name in MEANS}
    columns["episodes"] = np.array([len(evaluated.returns) for evaluated in results], np.float64)
    if len(episodes):
        columns["seconds"] = np.interp(steps, episodes.column("step"), episodes.column("seconds"))
    return Table({"step": steps, **columns})


def written(names: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Returns rows as the text of a CSV file; numbers after the named columns are those of a goal.

    >>> written(("step", "success"), [(10, 1.0, 0.5, 2.0)]).splitlines()
    ['step,success,goal_0,goal_1', '10,1.0,0.5,2.0']
    """
    cells = [*rows]
    goal = [f"goal_{i}" for i in range(len(cells[0]) - len(names))] if cells else []
    return "".join(",".join(map(str, row)) + "\n" for row in ([*names, *goal], *cells))


def flat(values: Mapping[str, object], prefix: str = "") -> Iterator[tuple[str, object]]:
    """Yields the values of nested mappings by dotted name. A schedule is one value.

    >>> dict(flat({"gamma": 0.9, "policy_kwargs": {"net_arch": [8]}}))
    {'gamma': 0.9, 'policy_kwargs.net_arch': [8]}
    """
    for name, value in values.items():
        if isinstance(value, Mapping) and value and not {"schedule", "noise"} & value.keys():
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def read_bytes(path: Path, limit: int, has_holes: bool = True) -> bytes:
    """Returns up to ``limit`` bytes of a regular file; never follows a symbolic link and never waits.

    Without ``has_holes`` it is read up to the first hole: a sparse file takes no room in an archive, and seconds to be read.

    Raises:
        OSError: if it cannot be read, or is something else than a regular file.
    """
    if not stat.S_ISREG(path.lstat().st_mode):
        raise OSError(f"{path.name} is not a regular file")
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    with os.fdopen(os.open(path, flags), "rb") as file:
        if not has_holes:
            with suppress(OSError, AttributeError):  # of an empty file, and of systems without holes
                limit = min(limit, file.seek(0, os.SEEK_HOLE))
            file.seek(0)
        return file.read(limit)


def read_table(path: Path, only: Collection[str] | None = None, skip_lines: int = 0) -> Table:
    """Returns the columns of a CSV file with a header line; an empty table, with a note, if there is none.

    Args:
        path: path of the file.
        only: names of the columns to read; None for all.
        skip_lines: lines before the header.
    """
    name = path.name
    try:
        data = read_bytes(path, MAX_BYTES + 1, has_holes=False)
    except FileNotFoundError:
        return Table({}, (f"there is no {name}",))
    except OSError as error:
        return Table({}, (f"{name} cannot be read: {shown(error.strerror or error)}",))
    notes = []
    if len(data) > MAX_BYTES:
        notes.append(f"only the first {MAX_BYTES >> 20} MiB of {name} were read")
    elif data and not data.endswith(b"\n"):
        notes.append(f"the last row of {name} is incomplete and was left out")
    file = io.BytesIO(data[: data.rfind(b"\n") + 1])
    del data
    for _ in range(skip_lines):
        file.readline(MAX_LINE)
    header = file.readline(MAX_LINE)
    if not header.strip():
        return Table({}, (*notes, f"{name} is empty"))
    try:
        names = next(csv.reader([header.decode("utf-8-sig", "replace").strip("\r\n")]), [])
    except csv.Error:  # a carriage return, or a name of 200,000 characters
        return Table({}, (*notes, f"the header of {name} is damaged"))
    if len(names) > MAX_COLUMNS or len({*names}) < len(names):
        return Table({}, (*notes, f"{name} has {len(names)} columns, expected up to {MAX_COLUMNS} of different names"))
    wanted = [i for i, column_name in enumerate(names) if only is None or column_name in only]
    columns, n_bad = numbers(file, len(names), wanted)
    if n_bad:
        notes.append(f"left out of {name}: {counted(n_bad, 'damaged row')}")
    if file.readline(1):
        notes.append(f"only the first {MAX_CELLS // len(names):,} lines of {name} were read")
    return Table({names[i]: column for i, column in zip(wanted, columns, strict=True)}, tuple(notes))


def lines_of(file: IO[AnyStr]) -> Iterator[AnyStr]:
    """Yields the lines of a file; one of more than ``MAX_LINE`` bytes, which is damage, in pieces."""
    while line := file.readline(MAX_LINE):
        yield line


def numbers(file: BinaryIO, n_columns: int, wanted: Sequence[int]) -> tuple[Iterable[np.ndarray], int]:
    """Returns the numbers in some columns of a CSV text, and how many rows have another number of cells than ``n_columns``.

    Tables without empty or damaged cells or text, such as those of episodes, are read by NumPy, four times as fast.
    """
    begin, n_lines = file.tell(), MAX_CELLS // n_columns
    if not (first := file.readline(MAX_LINE)):
        return np.zeros((len(wanted), 0)), 0
    with suppress(ValueError):
        lines = chain([first], islice(lines_of(file), n_lines - 1))
        values = np.loadtxt(lines, delimiter=",", comments=None, ndmin=2)
        if values.shape[1] == n_columns:
            return values[:, wanted].T, 0
    file.seek(begin)
    reader = csv.reader(line.decode("utf-8", "replace") for line in islice(lines_of(file), n_lines))
    columns, n_bad = [array("d") for _ in wanted], 0
    while True:
        try:
            row = next(reader, None)
        except csv.Error:  # such as a cell of 200,000 characters
            row = []
        if row is None:
            return [np.array(column) for column in columns], n_bad
        if len(row) != n_columns:
            n_bad += 1
            continue
        for column, i in zip(columns, wanted, strict=True):
            column.append(number(row[i]))


def number(word: str) -> float:
    """Returns a number, NaN for what is none; Python's words for true and false are 1 and 0."""
    try:
        return float({"True": 1, "False": 0}.get(word, word))
    except ValueError:
        return float("nan")
