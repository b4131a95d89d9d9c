"""Reading and drawing the files that ``Monitor`` writes."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rejeu.envs.monitor import SUFFIX
from rejeu.errors import MissingExtra

X_TIMESTEPS = "timesteps"
X_EPISODES = "episodes"
X_WALLTIME = "walltime_hrs"
POSSIBLE_X_AXES = (X_TIMESTEPS, X_EPISODES, X_WALLTIME)
EPISODES_WINDOW = 100
"""Episodes over which curves are averaged."""


class LoadMonitorResultsError(Exception):
    """There are no monitor files, or they cannot be read."""


def get_monitor_files(path: str | Path) -> list[str]:
    """Returns the monitor files of a folder, sorted."""
    return sorted(str(file) for file in Path(path).glob(f"*{SUFFIX}"))


def load_results(path: str | Path) -> np.recarray:
    """Returns the episodes of all monitor files of a folder, in the order in which they ended.

    A NumPy record array: ``table["r"]`` or ``table.r`` are returns, ``l`` lengths, ``t`` seconds since the first file was
    begun; the other columns of the files follow. ``pandas.DataFrame(table)`` makes a data frame of it.

    Raises:
        LoadMonitorResultsError: if there are none, or they do not have the same columns.
    """
    files = get_monitor_files(path)
    if not files:
        raise LoadMonitorResultsError(f"there are no files *{SUFFIX} in {path}; Monitor(env, folder) writes them")
    starts, rows, columns = [], [], None
    for name in files:
        with open(name, newline="", encoding="utf-8") as file:
            try:
                start = float(json.loads(file.readline().removeprefix("#"))["t_start"])
                reader = csv.DictReader(file)
                found = [{**row, "t": float(row["t"]) + start} for row in reader]
            except (ValueError, KeyError, TypeError) as error:
                raise LoadMonitorResultsError(f"{name} is no file that Monitor wrote: {error}") from None
        if columns not in (None, reader.fieldnames):
            raise LoadMonitorResultsError(f"{name} has the columns {reader.fieldnames}, the files before it {columns}")
        columns = reader.fieldnames
        starts.append(start)
        rows += found
    assert columns is not None
    rows.sort(key=lambda row: row["t"])
    arrays = {key: _column([row[key] for row in rows]) for key in columns}
    arrays["t"] = np.array([row["t"] for row in rows], np.float64) - min(starts)
    return np.rec.fromarrays([*arrays.values()], names=list(arrays))  # type: ignore[call-overload]


def _column(values: list[Any]) -> np.ndarray:
    """Returns the narrowest of whole numbers, numbers and strings that holds all values."""
    for kind in (np.int64, np.float64):
        try:
            return np.array(values, dtype=kind)
        except ValueError:
            continue
    return np.array(values, dtype=str)


def ts2xy(data_frame: Any, x_axis: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns what to draw against what: x ``(n,)`` and returns ``(n,)``.

    Args:
        data_frame: as :func:`load_results` returns it, or anything with the columns ``r``, ``l`` and ``t``.
        x_axis: ``"timesteps"`` taken when the episode ended, ``"episodes"`` or ``"walltime_hrs"``.

    Raises:
        ValueError: for another axis.
    """
    if x_axis not in POSSIBLE_X_AXES:
        raise ValueError(f"x_axis={x_axis!r} must be one of {', '.join(POSSIBLE_X_AXES)}")
    returns = np.asarray(data_frame["r"])
    if x_axis == X_TIMESTEPS:
        return np.cumsum(np.asarray(data_frame["l"])), returns
    if x_axis == X_EPISODES:
        return np.arange(len(returns)), returns
    return np.asarray(data_frame["t"]) / 3600.0, returns


def rolling_window(array: np.ndarray, window: int) -> np.ndarray:
    """Returns each ``window`` values in a row, ``(n - window + 1, window)``; a view."""
    return np.lib.stride_tricks.sliding_window_view(array, window, axis=-1)


def window_func(
    var_1: np.ndarray, var_2: np.ndarray, window: int, func: Callable[..., np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns ``var_1`` from the first full window on, and ``func(windows, axis=-1)`` of the windows of ``var_2``."""
    return var_1[window - 1 :], func(rolling_window(var_2, window), axis=-1)


def plot_curves(
    xy_list: Sequence[tuple[np.ndarray, np.ndarray]], x_axis: str, title: str, figsize: tuple[int, int] = (8, 2)
) -> None:
    """Draws returns as points, and their mean over 100 episodes as a line where there are so many, in a new figure.

    Raises:
        MissingExtra: if matplotlib is not installed.
    """
    try:
        from matplotlib import pyplot
    except ImportError:
        raise MissingExtra("drawing results", "matplotlib", "plot") from None
    pyplot.figure(title, figsize=figsize)
    for x, y in xy_list:
        pyplot.scatter(x, y, s=2)
        if len(x) >= EPISODES_WINDOW:
            pyplot.plot(*window_func(x, y, EPISODES_WINDOW, np.mean))
    pyplot.xlim(0, max((x[-1] for x, _ in xy_list if len(x)), default=1))
    pyplot.title(title)
    pyplot.xlabel(x_axis)
    pyplot.ylabel("Episode Rewards")
    pyplot.tight_layout()


def plot_results(
    dirs: Sequence[str | Path],
    num_timesteps: int | None,
    x_axis: str,
    task_name: str,
    figsize: tuple[int, int] = (8, 2),
) -> None:
    """Draws the monitor files of several folders, one curve each; ``matplotlib.pyplot.show()`` shows them.

    Args:
        dirs: folders.
        num_timesteps: leave out what ended later; None for nothing.
        x_axis: see :func:`ts2xy`.
        task_name: title.
        figsize: width and height in inches.
    """
    curves = []
    for folder in dirs:
        table = load_results(folder)
        curves.append(ts2xy(table if num_timesteps is None else table[np.cumsum(table["l"]) <= num_timesteps], x_axis))
    plot_curves(curves, x_axis, task_name, figsize)
