"""Logging of training statistics with Stable-Baselines3's classes.

A logger collects values until ``dump`` writes them to its output formats. Training calls ``dump`` with every row of
statistics.
"""

from __future__ import annotations

import csv
import io
import json
import os
import sys
import tempfile
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import partialmethod
from pathlib import Path
from typing import Any

import numpy as np

from rejeu.core import atomic
from rejeu.core.types import JsonObject
from rejeu.logs import logging
from rejeu.logs.formatting import LOGS
from rejeu.logs.logging import CsvFile, JsonLines, TensorBoard, add_text, open_log
from rejeu.logs.tables import lines_of

DEBUG, INFO, WARN, ERROR, DISABLED = 10, 20, 30, 40, 50


class Video:
    """Frames ``(batch, time, channels, height, width)`` for TensorBoard, at ``fps`` a second."""

    def __init__(self, frames: Any, fps: float) -> None:
        self.frames, self.fps = frames, fps


class Figure:
    """A figure of Matplotlib for TensorBoard; ``close`` closes it afterwards."""

    def __init__(self, figure: Any, close: bool) -> None:
        self.figure, self.close = figure, close


class Image:
    """An image for TensorBoard, with axes in the order of ``dataformats``, such as ``"CHW"``."""

    def __init__(self, image: Any, dataformats: str) -> None:
        self.image, self.dataformats = image, dataformats


class HParam:
    """Hyperparameters, and the names of metrics, for TensorBoard's page of hyperparameters."""

    def __init__(self, hparam_dict: Mapping[str, Any], metric_dict: Mapping[str, float | None]) -> None:
        if not metric_dict:
            raise Exception(
                "`metric_dict` must not be empty list to display hyperparameters to the HPARAMS tensorboard tab."
            )
        self.hparam_dict, self.metric_dict = hparam_dict, metric_dict


class FormatUnsupportedError(NotImplementedError):
    """A format cannot show a value."""

    def __init__(self, unsupported_formats: Sequence[str], value_description: str) -> None:
        formats = ", ".join(unsupported_formats)
        super().__init__(
            f"{formats} cannot show a {value_description}; exclude it: record(..., exclude={tuple(unsupported_formats)})"
        )


class KVWriter(ABC):
    """Writes rows of values by name. Abstract."""

    names: tuple[str, ...] = ()
    """Names of the format in ``exclude``."""

    @abstractmethod
    def write_row(self, row: Mapping[str, Any], step: int) -> None:
        """Writes a row, without what is excluded."""

    def write(self, key_values: Mapping[str, Any], key_excluded: Mapping[str, Any], step: int = 0) -> None:
        """Writes a row.

        Args:
            key_values: the values.
            key_excluded: names of the formats that leave a value out, by the name of the value.
            step: environment step.

        Raises:
            FormatUnsupportedError: for a value that the format cannot show.
        """
        row = filter_excluded_keys(key_values, key_excluded, *self.names)
        for value in row.values():
            if isinstance(value, Video | Figure | Image | HParam) and "tensorboard" not in self.names:
                raise FormatUnsupportedError(self.names, type(value).__name__.lower())
        self.write_row(row, step)

    def close(self) -> None:  # noqa: B027 - not every output needs it
        """Closes the output."""


def filter_excluded_keys(
    key_values: Mapping[str, Any], key_excluded: Mapping[str, Any], *formats: str
) -> dict[str, object]:
    """Returns the values that none of these formats leaves out."""
    excluded = {key: {*np.atleast_1d(key_excluded.get(key) or ())} for key in key_values}
    return {key: value for key, value in key_values.items() if not {*formats} & excluded[key]}


class HumanOutputFormat(KVWriter):
    """Prints rows as tables.

    Args:
        filename_or_file: path, or what has ``write`` and ``flush``.
        max_length: longest key or value, in characters.
    """

    names = ("stdout", "log")

    def __init__(self, filename_or_file: Any, max_length: int = 36) -> None:
        self.max_length = max_length
        self._owns = isinstance(filename_or_file, str | Path)
        self.file: Any = atomic.open_file(filename_or_file, "w", encoding="utf-8") if self._owns else filename_or_file
        if not hasattr(self.file, "write"):
            raise ValueError(f"Expected file or str, got {filename_or_file}")

    def write_row(self, row: Mapping[str, Any], step: int) -> None:
        shown: dict[tuple[str, str], str] = {}
        group = ""
        for key, value in sorted(row.items()):
            if "/" in key:
                group = key[: key.index("/") + 1]
                shown[group, self._truncated(group)] = ""
            name = f"{'':3}{key[len(group) :]}" if group and key.startswith(group) else key
            text = f"{value:<8.3g}" if isinstance(value, float) else str(value)
            if (group, self._truncated(name)) in shown:
                raise ValueError(
                    f"Key '{key}' truncated to '{self._truncated(name)}' that already exists; raise max_length"
                )
            shown[group, self._truncated(name)] = self._truncated(text)
        if not shown:
            warnings.warn("Tried to write empty key-value dict", stacklevel=2)
            return
        widths = max(len(name) for _, name in shown), max(map(len, shown.values()))
        dashes = "-" * (sum(widths) + 7)
        lines = [f"| {name:<{widths[0]}} | {value:<{widths[1]}} |" for (_, name), value in shown.items()]
        self.file.write("\n".join([dashes, *lines, dashes]) + "\n")
        self.file.flush()

    def _truncated(self, text: str) -> str:
        return text if len(text) <= self.max_length else f"{text[: self.max_length - 3]}..."

    def write_sequence(self, sequence: Sequence[str]) -> None:
        """Writes words in one line."""
        self.file.write(" ".join(sequence) + "\n")
        self.file.flush()

    def close(self) -> None:
        if self._owns:
            self.file.close()


class JSONOutputFormat(KVWriter):
    """Appends rows to a file of JSON lines; arrays become lists."""

    names = ("json",)

    def __init__(self, filename: str | Path) -> None:
        self.sink = JsonLines(filename)

    def write_row(self, row: Mapping[str, Any], step: int) -> None:
        if row:
            plain = (value if isinstance(value, str) else np.asarray(value).tolist() for value in row.values())
            self.sink.add(dict(zip(row, plain, strict=True)))


class CSVOutputFormat(KVWriter):
    """Appends rows to a CSV file, which gets a column for each new name."""

    names = ("csv",)

    def __init__(self, filename: str | Path) -> None:
        self.sink = CsvFile(filename)

    def write_row(self, row: Mapping[str, Any], step: int) -> None:
        if row:
            self.sink.add({key: "" if value is None else value for key, value in sorted(row.items())})


class TensorBoardOutputFormat(KVWriter):
    """Writes rows for TensorBoard: numbers, texts, arrays as histograms, images, figures, videos and hyperparameters.

    Raises:
        MissingExtra: if TensorBoard is not installed.
    """

    names = ("tensorboard",)

    def __init__(self, folder: str | Path) -> None:
        self.writer = TensorBoard(folder)

    def write_row(self, row: Mapping[str, Any], step: int) -> None:
        with self.writer.event(step) as summary:
            for key, value in row.items():
                _add(summary, key, value)


def _add(summary: Any, key: str, value: Any) -> None:
    """Adds a value to a summary of TensorBoard's; None, dicts and lists are left out, as there is no way to show them."""
    if isinstance(value, HParam):
        from tensorboard.plugins.hparams import api_pb2, metadata, plugin_data_pb2  # their summary needs TensorFlow

        names = [api_pb2.MetricInfo(name=api_pb2.MetricName(tag=name)) for name in value.metric_dict]
        start = plugin_data_pb2.SessionStartInfo(start_time_secs=time.time())
        for name, setting in value.hparam_dict.items():
            type_name = (
                "bool" if isinstance(setting, bool) else "number" if isinstance(setting, int | float) else "string"
            )
            setattr(start.hparams[name], f"{type_name}_value", str(setting) if type_name == "string" else setting)
        for tag, content in (
            (metadata.EXPERIMENT_TAG, {"experiment": api_pb2.Experiment(metric_infos=names)}),
            (metadata.SESSION_START_INFO_TAG, {"session_start_info": start}),
        ):
            summary_metadata = metadata.create_summary_metadata(plugin_data_pb2.HParamsPluginData(**content))
            summary.value.add(tag=tag, metadata=summary_metadata)
    elif isinstance(value, Figure):
        image = io.BytesIO()
        value.figure.savefig(image, format="png")
        summary.value.add(tag=key).image.encoded_image_string = image.getvalue()
        if value.close:
            from matplotlib import pyplot

            pyplot.close(value.figure)
    elif isinstance(value, Image):
        axes = [value.dataformats.index(axis) for axis in "HWC" if axis in value.dataformats]
        _add_image(summary, key, [np.asarray(value.image).transpose(axes)])
    elif isinstance(value, Video):
        _add_image(summary, key, [*np.asarray(value.frames)[0].transpose(0, 2, 3, 1)], value.fps)
    elif isinstance(value, str):
        add_text(summary, key, value)
    elif isinstance(value, int | float | np.number | np.bool_) and not isinstance(value, np.complexfloating):
        summary.value.add(tag=key, simple_value=float(value))
    elif hasattr(value, "dtype") and (array := np.asarray(value)).dtype.kind in "biuf" and np.isfinite(array).any():
        _add_histogram(summary, key, array[np.isfinite(array)].astype(np.float64))


def _add_image(summary: Any, key: str, frames: Sequence[np.ndarray], fps: float = 1.0) -> None:
    """Adds an image, or several as an animation, each ``(height, width, channels)``: bytes, or numbers in [0, 1]."""
    from PIL import Image as Pillow

    pixels = [frame if frame.dtype == np.uint8 else (frame * 255).clip(0, 255).astype(np.uint8) for frame in frames]
    first, *others = [Pillow.fromarray(x[..., 0] if x.ndim == 3 and x.shape[-1] == 1 else x) for x in pixels]
    image = io.BytesIO()
    if others:
        first.save(image, "gif", save_all=True, append_images=others, duration=1000 / fps, loop=0)
    else:
        first.save(image, "png")
    summary.value.add(tag=key).image.encoded_image_string = image.getvalue()


def _add_histogram(summary: Any, key: str, values: np.ndarray) -> None:
    counts, edges = np.histogram(values, bins=30)
    histogram = summary.value.add(tag=key).histo
    histogram.min, histogram.max, histogram.num = values.min(), values.max(), values.size
    histogram.sum, histogram.sum_squares = values.sum(), np.square(values).sum()
    histogram.bucket_limit.extend(edges[1:].tolist())
    histogram.bucket.extend(counts.tolist())


class _Rows:
    """The sink of an agent's rows that is a logger: it records them and calls ``dump``."""

    def __init__(self, logger: Logger) -> None:
        self.logger = logger

    def __str__(self) -> str:
        return "the logger"

    def write(self, step: int, metrics: Mapping[str, Any]) -> None:
        for key, value in metrics.items():
            self.logger.record(key, value, self.logger.exclusions.pop(key, None))
        self.logger.dump(step)
        self.logger.left = dict(self.logger.values)

    def close(self) -> None:
        """Does nothing: the user closes the logger."""


class Logger(logging.Logger):
    """Collects values until they are written.

    Args:
        folder: folder of its files.
        output_formats: what it writes to.
    """

    def __init__(self, folder: str | Path | None, output_formats: Sequence[KVWriter]) -> None:
        super().__init__()
        self.dir = None if folder is None else str(folder)
        self.outputs = [_Rows(self)]
        self.output_formats = [*output_formats]
        self.level = INFO
        self.name_to_excluded: dict[str, str | tuple[str, ...] | None] = {}
        self.exclusions: dict[str, str | tuple[str, ...] | None] = {}
        """The ``name_to_excluded`` of the row that :meth:`take` returned."""
        self.latest: Callable[[], Mapping[str, float]] = dict
        """Returns the statistics of the agent that trains."""
        self.left: dict[str, float] = {}
        """Values of the last row that a ``dump`` of one's own did not clear."""

    @property
    def name_to_value(self) -> dict[str, Any]:
        """The values recorded since the last row, and the ``train/`` statistics of the agent's latest update."""
        for key, value in self.latest().items():
            if key.startswith("train/") and (key not in self.values or self.values[key] is self.left.get(key)):
                self.values[key] = self.left[key] = value
        return self.values

    def record(self, key: str, value: Any, exclude: str | tuple[str, ...] | None = None) -> None:
        """Records a value for the next row, and replaces an earlier one.

        Args:
            key: name, ``group/name``.
            value: a number, text, array, :class:`Figure`, :class:`Image`, :class:`Video` or :class:`HParam`.
            exclude: formats that leave it out.
        """
        self.values[key], self.name_to_excluded[key] = value, exclude

    def record_mean(self, key: str, value: Any, exclude: str | tuple[str, ...] | None = None) -> None:
        """Records the mean of the values since the last row; None is ignored."""
        super().record_mean(key, value, exclude)
        self.name_to_excluded[key] = exclude

    def take(self) -> dict[str, Any]:
        """Returns and clears the recorded values."""
        for key in [key for key, value in self.left.items() if self.values.get(key) is value]:
            del self.values[key]
        self.left = {}
        self.exclusions, self.name_to_excluded = self.name_to_excluded, {}
        return super().take()

    def dump(self, step: int = 0) -> None:
        """Writes the recorded values as a row, and clears them."""
        row = self.take()
        if self.level < DISABLED:
            for output in self.output_formats:
                output.write(row, self.exclusions, step)

    def log(self, *args: Any, level: int = INFO) -> None:
        """Prints words to the formats that are tables."""
        for output in self.output_formats if self.level <= level else ():
            if isinstance(output, HumanOutputFormat):
                output.write_sequence([str(word) for word in args])

    debug = partialmethod(log, level=DEBUG)
    info = partialmethod(log, level=INFO)
    warn = partialmethod(log, level=WARN)
    error = partialmethod(log, level=ERROR)

    def set_level(self, level: int) -> None:
        """Sets the lowest level that is printed."""
        self.level = level

    def get_dir(self) -> str | None:
        """Returns the folder of its files."""
        return self.dir

    def close(self) -> None:
        """Closes the outputs."""
        for output in self.output_formats:
            output.close()


def make_output_format(_format: str, log_dir: str | Path, log_suffix: str = "") -> KVWriter:
    """Returns a format by its name: ``"stdout"``, ``"log"``, ``"json"``, ``"csv"`` or ``"tensorboard"``.

    Raises:
        ValueError: for another name.
    """
    folder = Path(log_dir)
    folder.mkdir(parents=True, exist_ok=True)
    formats: dict[str, Callable[[], KVWriter]] = {
        "stdout": lambda: HumanOutputFormat(sys.stdout),
        "log": lambda: HumanOutputFormat(folder / f"log{log_suffix}.txt"),
        "json": lambda: JSONOutputFormat(folder / f"progress{log_suffix}.json"),
        "csv": lambda: CSVOutputFormat(folder / f"progress{log_suffix}.csv"),
        "tensorboard": lambda: TensorBoardOutputFormat(folder),
    }
    if _format not in formats:
        raise ValueError(f"Unknown format specified: {_format}")
    return formats[_format]()


def configure(folder: str | Path | None = None, format_strings: Sequence[str] | None = None) -> Logger:
    """Returns a logger for ``model.set_logger``.

    Args:
        folder: of its files; None: ``$SB3_LOGDIR``, or a new folder of temporary files.
        format_strings: any of ``"stdout"``, ``"log"``, ``"json"``, ``"csv"``, ``"tensorboard"``, and of the trackers
            ``"wandb"``, ``"mlflow"`` and ``"trackio"``; None: ``$SB3_LOG_FORMAT``, or the first three and ``"csv"``.

    Raises:
        ValueError: for another format.
    """
    name = time.strftime("SB3-%Y-%m-%d-%H-%M-%S")
    folder = folder or os.getenv("SB3_LOGDIR") or str(Path(tempfile.gettempdir()) / name)
    names = format_strings or os.getenv("SB3_LOG_FORMAT", "stdout,log,csv").split(",")
    trackers = [log_name for log_name in names if log_name in LOGS and log_name not in ("csv", "json", "tensorboard")]
    formats = [make_output_format(log_name, folder) for log_name in names if log_name and log_name not in trackers]
    logger = Logger(str(folder), formats)
    logger.outputs += [open_log(log_name, Path(folder)) for log_name in trackers]
    return logger


def read_json(filename: str | Path) -> list[JsonObject]:
    """Returns the rows of a file of JSON lines."""
    with Path(filename).open(encoding="utf-8") as file:
        return [json.loads(line) for line in lines_of(file)]


def read_csv(filename: str | Path) -> list[dict[str, str]]:
    """Returns the rows of a CSV file, as text."""
    with Path(filename).open(encoding="utf-8", newline="") as file:
        return [*csv.DictReader(lines_of(file))]
