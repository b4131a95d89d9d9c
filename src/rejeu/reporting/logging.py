"""Logging of metrics to console, CSV and TensorBoard."""

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
from rejeu.io.failed_writes import FailedWrites
from rejeu.reporting.notebook import Display


class Sink(Protocol):
    """An output of metrics."""

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Writes the metrics of environment step ``step``. Names are ``group/name``."""

    def close(self) -> None:
        """Closes the output."""


class Console:
    """Prints metrics as a table, grouped by the part of the name before the slash.

    In a notebook one table is updated. Tables within ``seconds`` of the previous one are skipped, except for the last one,
    which :meth:`close` prints.

    Args:
        seconds: minimum time between two tables; 0 prints all.
    """

    def __init__(self, seconds: float = 0.0) -> None:
        self.seconds = seconds
        self._display: Display | None = None
        self._due = -math.inf
        self._skipped: tuple[int, Mapping[str, float]] | None = None

    def __str__(self) -> str:
        return "the console"

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        now = time.monotonic()
        if now < self._due:
            self._skipped = step, metrics
            return
        self._due, self._skipped = now + self.seconds, None
        self._show(step, metrics)

    def close(self) -> None:
        if self._skipped is not None:
            self._show(*self._skipped)
            self._skipped = None

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
    """Appends rows to a CSV file. A row may add columns, which are empty in the rows before it.

    Rows are written atomically. If existing rows or columns change, the file is replaced when the new one is complete.

    Args:
        path: path of the file.
        up_to: step up to which the rows of an existing file are kept; None starts an empty file.
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
            OSError: if writing fails; the file is not changed.
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
        """Does nothing, because rows are not buffered."""

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

    Rows are not buffered. TensorBoard's own writer uses a thread, which ends when a write fails and loses the buffered rows.
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
            OSError: if writing fails; the file is not changed.
        """
        event = self._event(wall_time=time.time(), step=step)
        for name, value in metrics.items():
            event.summary.value.add(tag=name, simple_value=value)
        self._append(event)

    def close(self) -> None:
        """Does nothing, because rows are not buffered."""

    def _append(self, event: Any) -> None:
        record = io.BytesIO()
        self._record_writer(record).write(event.SerializeToString())
        atomic.append(self.path, record.getvalue())


class Logger:
    """Collects metrics of callbacks until they are written.

    Args:
        folder: folder of its files, None for none.
        output_formats: sinks that replace console and TensorBoard.

    >>> logger = Logger()
    >>> logger.record("game/score", 3)
    >>> logger.take()
    {'game/score': 3}
    """

    def __init__(self, folder: str | Path | None = None, output_formats: Iterable[Sink] = ()) -> None:
        self.dir = None if folder is None else str(folder)
        self.outputs = list(output_formats)
        self.name_to_value: dict[str, float] = {}
        """Metrics recorded since the last row."""
        self.name_to_count: dict[str, int] = {}
        """Number of values in each mean since the last row."""

    def record(self, key: str, value: Any, exclude: str | tuple[str, ...] | None = None) -> None:
        """Records a metric for the next row, and replaces an earlier value.

        Args:
            key: name of the metric, ``group/name``.
            value: a number.
            exclude: accepted without effect; every output gets every metric.

        Raises:
            TypeError: if the value is not a number.
        """
        self.name_to_value[key] = _number(key, value)

    def record_mean(self, key: str, value: Any, exclude: str | tuple[str, ...] | None = None) -> None:
        """Records the mean of the values since the last row; None is ignored."""
        if value is None:
            return
        n = self.name_to_count[key] = self.name_to_count.get(key, 0) + 1
        mean = self.name_to_value.get(key, 0.0)
        self.name_to_value[key] = mean + (_number(key, value) - mean) / n

    def take(self) -> dict[str, float]:
        """Returns and clears the recorded metrics."""
        taken, self.name_to_value, self.name_to_count = self.name_to_value, {}, {}
        return taken

    def dump(self, step: int = 0) -> None:
        """Writes the recorded metrics as a row, and clears them."""
        row = self.take()
        for output in self.outputs if row else ():
            output.write(step, row)

    def get_dir(self) -> str | None:
        """Returns the folder of its files."""
        return self.dir

    def close(self) -> None:
        """Closes the outputs."""
        for output in self.outputs:
            output.close()


def configure(folder: str | Path | None = None, format_strings: Sequence[str] | None = None) -> Logger:
    """Returns a logger for ``agent.set_logger``.

    Args:
        folder: folder of the files, None for the current folder.
        format_strings: any of ``"stdout"``, ``"csv"`` (``progress.csv``) and ``"tensorboard"``; None for ``"stdout"``.

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
            raise ValueError(f"format_strings contains {kind!r}, expected 'stdout', 'csv' or 'tensorboard'")
    return Logger(folder, outputs)


def _number(key: str, value: Any) -> float:
    array = np.asarray(value)
    if array.dtype.kind not in "biuf" or array.size != 1:
        raise TypeError(f"record({key!r}) expected a number, got {type(value).__name__}")
    return array.item()


def next_folder(root: str | Path, name: str) -> Path:
    """Returns the first ``root/name_k`` (k from 1) that does not exist, as Stable-Baselines3 names its log folders."""
    root = Path(root)
    k = 1
    while (root / f"{name}_{k}").exists():
        k += 1
    return root / f"{name}_{k}"


class RetryingSink:
    """A sink whose rows are queued while they cannot be written."""

    def __init__(self, sink: Sink, failed: FailedWrites) -> None:
        self.sink = sink
        self._what = f"rows of {sink}"
        self._failed = failed

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Writes the metrics of environment step ``step``."""
        self._failed.put(self._what, self.sink.write, step, dict(metrics))

    def close(self) -> None:
        """Closes the sink."""
        self._failed.attempt(self._what, self.sink.close, retry=False)
