"""Plots of the files written by ``Monitor``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rejeu.core.errors import requires
from rejeu.sb3.common.monitor import load_results

X_TIMESTEPS = "timesteps"
X_EPISODES = "episodes"
X_WALLTIME = "walltime_hrs"
POSSIBLE_X_AXES = (X_TIMESTEPS, X_EPISODES, X_WALLTIME)
EPISODES_WINDOW = 100
"""Number of episodes over which curves are averaged."""


def ts2xy(data_frame: Any, x_axis: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns x coordinates ``(n,)`` and episode returns ``(n,)``.

    Args:
        data_frame: the result of :func:`load_results`, or any table with the columns ``r``, ``l`` and ``t``.
        x_axis: ``"timesteps"`` at the end of the episode, ``"episodes"`` or ``"walltime_hrs"``.

    Raises:
        ValueError: for an unknown axis.
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
    """Returns all windows of consecutive values, ``(n - window + 1, window)``; a view."""
    return np.lib.stride_tricks.sliding_window_view(array, window, axis=-1)


def window_func(
    var_1: np.ndarray, var_2: np.ndarray, window: int, func: Callable[..., np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns ``var_1`` from the first full window on, and ``func(windows, axis=-1)`` for the windows of ``var_2``."""
    return var_1[window - 1 :], func(rolling_window(var_2, window), axis=-1)


def plot_curves(
    xy_list: Sequence[tuple[np.ndarray, np.ndarray]], x_axis: str, title: str, figsize: tuple[int, int] = (8, 2)
) -> None:
    """Plots returns as points, and their mean over 100 episodes as a line, in a new figure.

    Raises:
        MissingExtra: if matplotlib is not installed.
    """
    with requires("plotting results", "matplotlib", "plot"):
        from matplotlib import pyplot
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
    """Plots the monitor files of several folders, one curve for each; ``matplotlib.pyplot.show()`` shows them.

    Args:
        dirs: folders.
        num_timesteps: omit episodes that end later; None omits none.
        x_axis: see :func:`ts2xy`.
        task_name: title.
        figsize: width and height in inches.
    """
    curves = []
    for folder in dirs:
        table = load_results(folder)
        curves.append(ts2xy(table if num_timesteps is None else table[np.cumsum(table["l"]) <= num_timesteps], x_axis))
    plot_curves(curves, x_axis, task_name, figsize)
