"""Where numbers go while training: one ``write(step, metrics)`` for console, CSV and TensorBoard."""

from __future__ import annotations

import csv
import io
import math
import os
import secrets
import socket
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from rejeu.errors import MissingExtra
from rejeu.io import atomic
from rejeu.reporting.notebook import Display


class Sink(Protocol):
    """Something that takes metrics."""

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Takes the metrics of environment step ``step``; names are ``group/name``."""

    def close(self) -> None:
        """Finishes."""


class Console:
    """Shows metrics as a table, grouped by the part of the name before the slash.

    In a notebook one table is kept up to date; elsewhere each is printed. Tables that come faster than ``seconds`` are left
    out, except for the last, which :meth:`close` shows.

    Args:
        seconds: least time between two tables; 0 shows all.
    """

    def __init__(self, seconds: float = 0.0) -> None:
        self.seconds = seconds
        self._display: Display | None = None
        self._due = -math.inf
        self._left_out: tuple[int, Mapping[str, float]] | None = None

    def __str__(self) -> str:
        return "the console"

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        now = time.monotonic()
        if now < self._due:
            self._left_out = step, metrics
            return
        self._due, self._left_out = now + self.seconds, None
        self._show(step, metrics)

    def close(self) -> None:
        if self._left_out is not None:
            self._show(*self._left_out)
            self._left_out = None

    def _show(self, step: int, metrics: Mapping[str, float]) -> None:
        from rich import box
        from rich.console import Console as RichConsole
        from rich.table import Table

        table = Table(box=box.SIMPLE, show_header=False, title=f"step {step:,}", title_justify="left")
        table.add_column()
        table.add_column(justify="right")
        group = None
        for name, value in metrics.items():
            head, _, tail = name.partition("/")
            if head != group:
                table.add_row(f"[bold]{head}[/bold]", "")
                group = head
            table.add_row(f"  {tail}", f"{value:.4g}" if isinstance(value, float) else f"{value:,}")
        console = RichConsole()
        if not console.is_jupyter:
            console.print(table)
            return
        text = io.StringIO()
        RichConsole(file=text, force_jupyter=False, width=console.width).print(table)
        self._display = self._display or Display()
        self._display.show("\n".join(line.rstrip() for line in text.getvalue().strip().splitlines()))


class CsvFile:
    """Appends rows to a CSV file; a row may bring new columns, which are then empty in those before it.

    Each row is there entirely or not at all. Where rows or columns that are already written change, a new file takes the
    place of the old one once it is complete.

    Args:
        path: of the file.
        up_to: of a file that is there already, keep the rows up to this step; None starts an empty one.
    """

    def __init__(self, path: str | Path, up_to: int | None = None) -> None:
        self.path = Path(path)
        self._columns: list[str] = []
        kept: list[dict[str, str]] = []
        if up_to is not None and self.path.exists():
            rows = [row for row in self._read() if (row.get("step") or "").isdigit()]
            kept = [row for row in rows if int(row["step"]) <= up_to and None not in row and None not in row.values()]
        if kept:
            self._columns = [*kept[0]]
        content = self._header() + self._lines(kept)
        if not self.path.exists() or self.path.read_bytes() != content:
            self._replace(content)

    def __str__(self) -> str:
        return str(self.path)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Adds a row.

        Raises:
            OSError: if that is impossible; the file is then as it was.
        """
        row = {"step": step, **metrics}
        if new := [name for name in row if name not in self._columns]:
            rows = self._read()
            before, self._columns = self._columns, [*self._columns, *new]
            try:
                self._replace(self._header() + self._lines([*rows, row]))
            except OSError:
                self._columns = before
                raise
        else:
            atomic.append(self.path, self._lines([row]))

    def close(self) -> None:
        """Does nothing: rows are in the file as soon as they are written."""

    def _read(self) -> list[dict[str, str]]:
        with self.path.open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(line for line in file if "\0" not in line))

    def _header(self) -> bytes:
        return self._lines([{name: name for name in self._columns}]) if self._columns else b""

    def _lines(self, rows: Iterable[Mapping[str, Any]]) -> bytes:
        text = io.StringIO()
        csv.DictWriter(text, self._columns, restval="").writerows(rows)
        return text.getvalue().encode()

    def _replace(self, content: bytes) -> None:
        with atomic.replacing(self.path) as file:
            file.write(content)


class TensorBoard:
    """Writes scalars for TensorBoard into a folder.

    Each row is appended at once, where TensorBoard's own writer does so in a thread, which ends when a write fails and takes
    the rows that wait with it.
    """

    def __init__(self, folder: str | Path) -> None:
        try:
            from tensorboard.compat.proto.event_pb2 import Event
            from tensorboard.summary.writer.record_writer import RecordWriter
        except ImportError:
            raise MissingExtra("tensorboard_log", "tensorboard", "tensorboard") from None
        self._event, self._record_writer = Event, RecordWriter
        name = f"events.out.tfevents.{time.time_ns() // 10**9:010d}.{socket.gethostname()}.{os.getpid()}"
        self.path = Path(folder) / f"{name}.{secrets.token_hex(4)}"
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.touch(exist_ok=False)
        self._append(Event(wall_time=time.time(), file_version="brain.Event:2"))

    def __str__(self) -> str:
        return str(self.path)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Adds a row.

        Raises:
            OSError: if that is impossible; the file is then as it was.
        """
        event = self._event(wall_time=time.time(), step=step)
        for name, value in metrics.items():
            event.summary.value.add(tag=name, simple_value=value)
        self._append(event)

    def close(self) -> None:
        """Does nothing: rows are in the file as soon as they are written."""

    def _append(self, event: Any) -> None:
        record = io.BytesIO()
        self._record_writer(record).write(event.SerializeToString())
        atomic.append(self.path, record.getvalue())


class Logger:
    """Collects numbers by name until they are written: what callbacks add to the rows of a run.

    Args:
        folder: where its files lie, None for nowhere.
        output_formats: sinks that take the rows, in place of console and TensorBoard.

    >>> logger = Logger()
    >>> logger.record("game/score", 3)
    >>> logger.take()
    {'game/score': 3}
    """

    def __init__(self, folder: str | Path | None = None, output_formats: Iterable[Sink] = ()) -> None:
        self.dir = None if folder is None else str(folder)
        self.outputs = list(output_formats)
        self.name_to_value: dict[str, float] = {}
        """What was recorded since the last row."""
        self.name_to_count: dict[str, int] = {}
        """How many numbers the means among them are of."""

    def record(self, key: str, value: Any, exclude: str | tuple[str, ...] | None = None) -> None:
        """Adds a number to the next row, in place of one of that name.

        Args:
            key: its name, ``group/name``.
            value: a number.
            exclude: accepted and without effect: every place gets every number.

        Raises:
            TypeError: if it is no number.
        """
        self.name_to_value[key] = _number(key, value)

    def record_mean(self, key: str, value: Any, exclude: str | tuple[str, ...] | None = None) -> None:
        """Does the same with the mean of what was given under that name since the last row; None is passed over."""
        if value is None:
            return
        n = self.name_to_count[key] = self.name_to_count.get(key, 0) + 1
        mean = self.name_to_value.get(key, 0.0)
        self.name_to_value[key] = mean + (_number(key, value) - mean) / n

    def take(self) -> dict[str, float]:
        """Returns what was recorded, and forgets it."""
        taken, self.name_to_value, self.name_to_count = self.name_to_value, {}, {}
        return taken

    def dump(self, step: int = 0) -> None:
        """Writes what was recorded as a row of its own, and forgets it."""
        row = self.take()
        for output in self.outputs if row else ():
            output.write(step, row)

    def get_dir(self) -> str | None:
        """Returns where its files lie."""
        return self.dir

    def close(self) -> None:
        """Finishes the outputs."""
        for output in self.outputs:
            output.close()


def configure(folder: str | Path | None = None, format_strings: Sequence[str] | None = None) -> Logger:
    """Returns a logger for ``agent.set_logger``.

    Args:
        folder: where the files go; None is the working folder.
        format_strings: of ``"stdout"``, ``"csv"`` (``progress.csv``) and ``"tensorboard"``; None: ``"stdout"``.

    Raises:
        ValueError: for another format.
    """
    folder = Path("." if folder is None else folder)
    outputs: list[Sink] = []
    for kind in ["stdout"] if format_strings is None else format_strings:
        if kind == "stdout":
            outputs.append(Console())
        elif kind == "csv":
            outputs.append(CsvFile(folder / "progress.csv"))
        elif kind == "tensorboard":
            outputs.append(TensorBoard(folder))
        else:
            raise ValueError(f"format_strings has {kind!r}; there are 'stdout', 'csv' and 'tensorboard'")
    return Logger(folder, outputs)


def _number(key: str, value: Any) -> float:
    array = np.asarray(value)
    if array.dtype.kind not in "biuf" or array.size != 1:
        raise TypeError(
            f"record({key!r}) takes a number, got {type(value).__name__}; write other things to files of yours"
        )
    return array.item()


def next_folder(root: str | Path, name: str) -> Path:
    """Returns ``root/name_k`` with the first k from 1 that is free, as Stable-Baselines3 names its log folders."""
    root = Path(root)
    k = 1
    while (root / f"{name}_{k}").exists():
        k += 1
    return root / f"{name}_{k}"
