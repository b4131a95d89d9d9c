"""Logging of metrics: to console, CSV, JSON lines and TensorBoard, and to the trackers of :mod:`rejeu.logs.trackers`."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import re
import secrets
import socket
import threading
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Protocol

import numpy as np

from rejeu.core import atomic
from rejeu.core.errors import requires
from rejeu.core.failed_writes import FailedWrites
from rejeu.core.validation import as_path
from rejeu.logs import trackers
from rejeu.logs.formatting import LOGS, Display
from rejeu.logs.history import csv_lines
from rejeu.logs.tables import flat, read_bytes
from rejeu.logs.trackers import MLflow, Tracker, Trackio, WandB

TRACKERS = ("wandb", "mlflow", "trackio")
CLOSE_SECONDS = 60.0
"""Longest wait at the end of training for what a tracker has not yet written."""
MAX_ROWS = 10_000
"""Upper limit on the rows that wait for a slow tracker; beyond it new ones are lost."""
MAX_LOG_BYTES = 2**30
"""Upper limit on the size of a log that is continued."""
NUMBERS = re.compile(rb"[0-9]{1,18}(,[-+.\w]{0,64})*\r?\n", re.ASCII)
"""A row of a table: a step, and numbers or nothing."""


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
        up_to: step up to which the rows of an existing file are kept; None starts an empty file. A file that is no table with
            a column ``step`` is renamed, with a warning.

    Raises:
        OSError: if an existing file cannot be read, is a symbolic link, or is larger than ``MAX_LOG_BYTES``.
    """

    def __init__(self, path: str | Path, up_to: int | None = None) -> None:
        self.path = as_path(path)
        self._columns: list[str] = []
        restart(self.path, [] if up_to is None or not self.path.exists() else self._lines_up_to(up_to), up_to)

    def __str__(self) -> str:
        return str(self.path)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        self.add({"step": step, **metrics})

    def add(self, row: Mapping[str, object]) -> None:
        """Adds a row.

        Raises:
            OSError: if writing fails; the file is not changed.
        """
        new = [name for name in row if name not in self._columns]
        columns = [*self._columns, *new]
        line = csv_lines([[row.get(name, "") for name in columns]])
        if new:
            rows = [row + b"," * len(new) + b"\r\n" for row in read_log(self.path).splitlines()[1:]]
            atomic.write(self.path, b"".join([csv_lines([columns]), *rows, line]))
            self._columns = columns
        else:
            atomic.append(self.path, line)

    def close(self) -> None:
        """Does nothing, because rows are not buffered."""

    def _lines_up_to(self, step: int) -> list[bytes]:
        """Returns the header and the complete rows up to a step; none, with a warning, if the file is no table with steps."""
        header, *rows = read_log(self.path).splitlines(keepends=True) or [b""]
        try:
            columns = next(csv.reader([header.decode("utf-8", "replace").strip()]), [])
        except csv.Error:  # such as a cell of 200,000 characters
            columns = ["damaged"]
        if columns and columns[0] != "step":
            aside = self.path.with_name(f"{self.path.name}.damaged")
            self.path.replace(aside)
            warnings.warn(f"{self.path} is damaged and is now {aside.name}; a new table begins", stacklevel=4)
            return []
        if not header.endswith(b"\n"):
            return []
        self._columns = columns
        whole = (row for row in rows if NUMBERS.fullmatch(row) and row.count(b",") == len(columns) - 1)
        return [header, *(row for row in whole if int(row.split(b",")[0]) <= step)]


class JsonLines:
    """Appends rows to a file of JSON lines: one object for each row, with ``step`` first. NaN and infinities are null.

    Args:
        path: path of the file.
        up_to: step up to which the rows of an existing file are kept; None starts an empty file.
    """

    def __init__(self, path: str | Path, up_to: int | None = None) -> None:
        self.path = as_path(path)
        lines = [] if up_to is None or not self.path.exists() else read_log(self.path).splitlines(keepends=True)
        restart(self.path, [line for line in lines if up_to is not None and _has_step(line, up_to)], up_to)

    def __str__(self) -> str:
        return str(self.path)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        self.add({"step": step, **{name: x if math.isfinite(x) else None for name, x in metrics.items()}})

    def add(self, row: Mapping[str, object]) -> None:
        """Adds a row.

        Raises:
            OSError: if writing fails; the file is not changed.
        """
        atomic.append(self.path, (json.dumps(row) + "\n").encode())

    def close(self) -> None:
        """Does nothing, because rows are not buffered."""


def restart(path: Path, lines: Sequence[bytes], up_to: int | None) -> None:
    """Writes the lines of a log that are kept, unless the file has these and no others, or starts an empty file."""
    content = b"".join(lines)
    if up_to is None or not path.exists() or read_log(path) != content:
        atomic.write(path, content)


def read_log(path: Path) -> bytes:
    """Returns the content of a log.

    Raises:
        OSError: if it cannot be read, is no regular file, or is larger than ``MAX_LOG_BYTES``.
    """
    content = read_bytes(path, MAX_LOG_BYTES + 1)
    if len(content) > MAX_LOG_BYTES:
        raise OSError(f"{path} has more than {MAX_LOG_BYTES >> 30} GiB; move it away, and a new one begins")
    return content


def _has_step(line: bytes, up_to: int) -> bool:
    """Returns whether a line of JSON is complete and of a step up to ``up_to``."""
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return False
    step = row.get("step") if isinstance(row, dict) else None
    return line.endswith(b"\n") and isinstance(step, int) and step <= up_to


class TensorBoard:
    """Writes scalars for TensorBoard into a folder, and the configuration as text.

    Rows are not buffered. TensorBoard's own writer uses a thread, which ends when a write fails and loses the buffered rows.
    """

    def __init__(self, folder: str | Path) -> None:
        self._event, self._record_writer = import_tensorboard()
        name = f"events.out.tfevents.{time.time_ns() // 10**9:010d}.{socket.gethostname()}.{os.getpid()}"
        self.path = Path(folder) / f"{name}.{secrets.token_hex(4)}"
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.touch(exist_ok=False)
        self._append(self._event(wall_time=time.time(), file_version="brain.Event:2"))

    def __str__(self) -> str:
        return str(self.path)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Adds a row.

        Raises:
            OSError: if writing fails; the file is not changed.
        """
        with self.event(step) as summary:
            for name, value in metrics.items():
                summary.value.add(tag=name, simple_value=value)

    @contextmanager
    def event(self, step: int) -> Iterator[Any]:
        """Yields a summary of TensorBoard's, and writes what was put into it."""
        event = self._event(wall_time=time.time(), step=step)
        yield event.summary
        self._append(event)

    def write_config(self, config: Mapping[str, object]) -> None:
        """Writes the configuration as a table, in TensorBoard's tab "Text"."""
        cells = [(name, str(value).replace("|", "\\|")) for name, value in flat(config)]
        table = "\n".join(["| name | value |", "|---|---|", *(f"| {name} | {value} |" for name, value in cells)])
        with self.event(0) as summary:
            add_text(summary, "config", table)

    def write_video(self, step: int, path: Path) -> None:
        """Does nothing, because TensorBoard shows no videos."""

    def close(self) -> None:
        """Does nothing, because rows are not buffered."""

    def _append(self, event: Any) -> None:
        record = io.BytesIO()
        self._record_writer(record).write(event.SerializeToString())
        atomic.append(self.path, record.getvalue())


def add_text(summary: Any, name: str, text: str) -> None:
    """Adds a text in Markdown to a summary of TensorBoard's."""
    value = summary.value.add(tag=f"{name}/text_summary")
    value.metadata.plugin_data.plugin_name = "text"
    value.tensor.dtype = 7  # DT_STRING
    value.tensor.string_val.append(text.encode())


def import_tensorboard() -> tuple[Any, Any]:
    """Returns TensorBoard's classes of events and of the writer of records.

    Raises:
        MissingExtra: if it is not installed.
    """
    with requires("logging to TensorBoard", "tensorboard", "tensorboard"):
        from tensorboard.compat.proto.event_pb2 import Event
        from tensorboard.summary.writer.record_writer import RecordWriter
    return Event, RecordWriter


class Logger:
    """Collects metrics of callbacks until they are written.

    >>> logger = Logger()
    >>> logger.record("game/score", 3)
    >>> logger.take()
    {'game/score': 3}
    """

    def __init__(self) -> None:
        self.outputs: list[Sink] = []
        """The outputs of the current ``learn``."""
        self.values: dict[str, float] = defaultdict(float)
        """Metrics recorded since the last row."""
        self.name_to_count: dict[str, int] = {}
        """Number of values in each mean since the last row."""

    def record(self, key: str, value: object, exclude: str | tuple[str, ...] | None = None) -> None:
        """Records a metric for the next row, and replaces an earlier value.

        Args:
            key: name of the metric, ``group/name``.
            value: a number.
            exclude: for callbacks of Stable-Baselines3; every output gets every metric.

        Raises:
            TypeError: if the value is not a number.
        """
        self.values[key] = _number(key, value)

    def record_mean(self, key: str, value: object, exclude: str | tuple[str, ...] | None = None) -> None:
        """Records the mean of the values since the last row; None is ignored."""
        if value is None:
            return
        n = self.name_to_count[key] = self.name_to_count.get(key, 0) + 1
        mean = self.values.get(key, 0.0)
        self.values[key] = mean + (_number(key, value) - mean) / n

    def take(self) -> dict[str, float]:
        """Returns and clears the recorded metrics."""
        values, self.values, self.name_to_count = self.values, defaultdict(float), {}
        return dict(values)

    def dump(self, step: int = 0) -> None:
        """Writes the recorded metrics as a row, and clears them."""
        if row := self.take():
            self.write(step, row)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Writes a row to every output, without what is recorded."""
        for output in self.outputs:
            output.write(step, metrics)

    def write_video(self, step: int, path: str | Path) -> None:
        """Adds a video to the outputs that take videos."""
        for output in self.outputs:
            if isinstance(output, Tracker):
                output.write_video(step, Path(path))


def check_logs(name: str, value: str | Iterable[str]) -> tuple[str, ...]:
    """Returns the names of logs that an argument gives, each once.

    Raises:
        ValueError: for an unknown one.
    """
    names = tuple(dict.fromkeys([value] if isinstance(value, str) else value))
    for log_name in names:
        if log_name not in LOGS:
            raise ValueError(f"{name} contains {log_name!r}, expected any of {', '.join(map(repr, LOGS))}")
    return names


def require(names: Iterable[str]) -> None:
    """Imports what the logs need.

    Raises:
        MissingExtra: if a package is not installed, with the command that installs it.
    """
    for name in names:
        if name == "tensorboard":
            import_tensorboard()
        elif name in TRACKERS:
            trackers.imported(name)


def open_log(
    log_name: str,
    folder: Path,
    name: str | None = None,
    run_id: str | None = None,
    stem: str = "progress",
    up_to: int | None = None,
) -> Sink:
    """Returns the output of a name in ``LOGS``.

    Args:
        log_name: the name.
        folder: folder of its files.
        name: name of the run in a tracker.
        run_id: identifies the run in a tracker.
        stem: name of its file without the suffix.
        up_to: step up to which the rows of an existing file are kept; None starts an empty file.

    Raises:
        MissingExtra: if its package is not installed.
    """
    if log_name == "csv":
        return CsvFile(folder / f"{stem}.csv", up_to)
    if log_name == "json":
        return JsonLines(folder / f"{stem}.json", up_to)
    if log_name == "tensorboard":
        return TensorBoard(folder)
    if log_name == "wandb":
        return WandB(name, run_id, folder)
    return MLflow(name, run_id) if log_name == "mlflow" else Trackio(name)


def _number(key: str, value: object) -> float:
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


class GuardedSink:
    """A sink whose failures are reported instead of raised; a row that fails is lost.

    Args:
        sink: the sink.
        failed: where its failures are reported.
        closes: whether :meth:`close` also closes the sink.
        in_background: write in a thread, so that a slow or lost connection neither delays nor ends training. What fails is
            reported with the next row. Other threads may not use the sink until :meth:`close` returns.
    """

    def __init__(self, sink: Sink, failed: FailedWrites, closes: bool = True, in_background: bool = False) -> None:
        self.sink, self.closes, self.in_background = sink, closes, in_background
        self._name, self._failed = f"rows of {sink}", failed
        self._jobs: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._work, name=f"rejeu, {sink}", daemon=True)
        if in_background:
            self._thread.start()

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Writes the metrics of environment step ``step``."""
        self._put(partial(self.sink.write, step, dict(metrics)))

    def write_config(self, config: Mapping[str, object]) -> None:
        """Writes the configuration, if the sink takes one."""
        if isinstance(self.sink, Tracker):
            self._put(partial(self.sink.write_config, config))

    def write_video(self, step: int, path: Path) -> None:
        """Adds a video, if the sink takes any."""
        if isinstance(self.sink, Tracker):
            self._put(partial(self.sink.write_video, step, path))

    def close(self) -> None:
        """Closes the sink. A thread gets up to ``CLOSE_SECONDS`` for the rows that wait."""
        if not self.in_background:
            self._failed.attempt(self._name, self.sink.close, is_row=True)
            return
        if self.closes:
            self._jobs.put(self.sink.close)
        self._jobs.put(None)
        self._thread.join(CLOSE_SECONDS)
        if self._thread.is_alive() and self._error is None:
            self._error = TimeoutError(f"not done {CLOSE_SECONDS:.0f} seconds after the end of training")
        self._failed.attempt(self._name, self._raise_error, is_row=True)

    def _put(self, job: Callable[[], object]) -> None:
        if not self.in_background:
            self._failed.attempt(self._name, job, is_row=True)
            return
        if self._jobs.qsize() < MAX_ROWS:
            self._jobs.put(job)
        else:
            self._error = OverflowError(f"{MAX_ROWS:,} rows wait, and no more can")
        self._failed.attempt(self._name, self._raise_error, is_row=True)

    def _raise_error(self) -> None:
        if self._error is not None:
            raise OSError(f"{type(self._error).__name__}: {self._error}"[:500])

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job()
            except Exception as error:  # of any kind, as each library has its own
                self._error = error


def guarded(sink: Sink, failed: FailedWrites, closes: bool = False) -> GuardedSink:
    """Returns a sink whose failures are reported instead of raised; trackers are written to in the background."""
    if isinstance(sink, GuardedSink):
        return sink
    return GuardedSink(sink, failed, closes, in_background=isinstance(sink, WandB | MLflow | Trackio))
