"""Trajectory of an episode: coordinates against time, and the plane of the first two."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from rejeu.reporting.plots import drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rejeu.reporting.plots.picture import Picture

MAX_COORDINATES = 10
"""Maximum number of coordinates that are drawn against time next to the plane."""
NAME_CHARACTERS = 64
"""Characters of names that fit above each other, next to the panels of all coordinates."""
MARGIN = 0.08
"""Margin beyond the bounds, as a share of their distance."""


def trajectory(
    positions: ArrayLike,
    path: str | Path | None = None,
    *,
    low: ArrayLike | None = None,
    high: ArrayLike | None = None,
    names: Sequence[str] | None = None,
    title: str = "",
) -> Picture:
    """Draws the trajectory of an episode.

    One coordinate is drawn against steps, two as a plane, more as the plane of the first two and each coordinate (at most
    ten) against steps.

    Args:
        positions: positions or observations, oldest first, ``(n, dimension)``, or ``(n,)`` for one coordinate.
        path: file to write, in the format of its suffix (``.png``, ``.svg``, ``.pdf``); None for none.
        low: lower bound, a number or ``(dimension,)``, drawn as a wall where it is finite; None for none.
        high: upper bound, the same.
        names: names of the coordinates; None for x1, x2 and so on.
        title: title of the figure, empty for none.

    Raises:
        MissingExtra: if matplotlib is not installed.
        ValueError: if the positions are not ``(n, dimension)`` with at least one row, or the number of names differs.
    """
    points = np.asarray(positions, np.float64)
    points = points[:, None] if points.ndim == 1 else points
    if points.ndim != 2 or 0 in points.shape:
        raise ValueError(f"positions have the shape {points.shape}, expected (n, dimension) with at least one row")
    dimension = points.shape[1]
    names = [f"x{i + 1}" for i in range(dimension)] if names is None else list(names)
    if len(names) != dimension:
        raise ValueError(f"names={names} must name all {dimension} coordinates")
    lows = np.broadcast_to(np.asarray(-np.inf if low is None else low, np.float64), dimension)
    highs = np.broadcast_to(np.asarray(np.inf if high is None else high, np.float64), dimension)

    what = "drawing a trajectory"
    if dimension == 1:
        figure = drawing.make_figure(what)
        panel = figure.subplots()
        _coordinate(panel, points[:, 0], lows[0], highs[0], names[0])
        panel.set_xlabel("step")
        drawing.add_title_and_legend(panel, title)
    elif dimension == 2:
        figure = drawing.make_figure(what, 5.6, 5.6)
        _plane(figure.subplots(), points, lows, highs, names, title)
    else:
        figure = drawing.make_figure(what, 10.0, 5.6)
        left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=[5.6, 4.4])[0]
        _plane(left.subplots(), points, lows, highs, names, title)
        shown = min(dimension, MAX_COORDINATES)
        panels = right.subplots(shown, 1, sharex=True)
        for i, panel in enumerate(panels):
            name = textwrap.fill(names[i], NAME_CHARACTERS // shown, break_long_words=False)
            _coordinate(panel, points[:, i], lows[i], highs[i], name)
        panels[-1].set_xlabel("step" if shown == dimension else f"step (the first {shown} of {dimension} coordinates)")
    return drawing.save(figure, path)


def _plane(
    panel: Axes, points: np.ndarray, lows: np.ndarray, highs: np.ndarray, names: Sequence[str], title: str
) -> None:
    """Draws the first two coordinates, the box, the start and the end."""
    x, y = points[:, 0], points[:, 1]
    if np.isfinite([lows[:2], highs[:2]]).all():
        corners = (lows[0], lows[1]), highs[0] - lows[0], highs[1] - lows[1]
        from matplotlib.patches import Rectangle

        panel.add_patch(Rectangle(*corners, fill=False, edgecolor=drawing.INK, linewidth=1.2))
    panel.plot(x, y, ".-", color=drawing.LINE_COLOR, linewidth=0.7, markersize=3, alpha=0.6)
    _ends(panel, x, y)
    panel.set_xlim(*_limits(x, lows[0], highs[0]))
    panel.set_ylim(*_limits(y, lows[1], highs[1]))
    panel.set_box_aspect(1)
    panel.set_xlabel(names[0])
    panel.set_ylabel(names[1])
    drawing.format_axes(panel)
    drawing.add_title_and_legend(panel, title)


def _coordinate(panel: Axes, values: np.ndarray, low: float, high: float, name: str) -> None:
    """Draws one coordinate against steps, its bounds, the start and the end."""
    for wall in (low, high):
        if np.isfinite(wall):
            panel.axhline(wall, color=drawing.INK, linewidth=1.2)
    steps = np.arange(len(values))
    panel.plot(steps, values, color=drawing.LINE_COLOR, linewidth=1.0)
    _ends(panel, steps, values)
    panel.locator_params(axis="x", integer=True)
    panel.xaxis.set_major_formatter(drawing.thousands)
    panel.set_ylim(*_limits(values, low, high))
    panel.set_ylabel(name)
    drawing.format_axes(panel)


def _ends(panel: Axes, x: np.ndarray, y: np.ndarray) -> None:
    panel.plot(x[:1], y[:1], "o", markersize=6, color="white", markeredgecolor=drawing.MUTED, label="start", zorder=4)
    panel.plot(x[-1:], y[-1:], "o", markersize=7, color=drawing.ACCENT_COLOR, label="end", zorder=5, clip_on=False)


def _limits(values: np.ndarray, low: float, high: float) -> tuple[float, float]:
    """Returns the axis limits of a coordinate: its bounds and all its values, with a margin."""
    finite = values[np.isfinite(values)]
    shown = np.array([*finite, *(wall for wall in (low, high) if np.isfinite(wall))])
    if not len(shown):
        return -1.0, 1.0
    margin = MARGIN * (float(np.ptp(shown)) or 1.0)
    return float(shown.min()) - margin, float(shown.max()) + margin
