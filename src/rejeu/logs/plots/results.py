"""Figures of results: learning curves, evaluations, comparisons of groups of runs, and trajectories of episodes."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from rejeu.core.validation import choice, whole
from rejeu.logs import charts
from rejeu.logs.plots import drawing
from rejeu.logs.tables import Table, evaluation_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rejeu.logs.plots.picture import Picture


AXES: dict[str, tuple[str, float, str]] = {
    "step": ("x", 1.0, "environment steps"),
    "seconds": ("t", 60.0, "seconds of training"),
}
"""For each axis its name in a chart, its factor and its title."""
RIGHT_MARGIN = 0.02
"""Share of the horizontal axis beyond the last episode."""
MAX_PANELS = 12
"""Most environments in the figure of a comparison."""


def learning_curve(
    history: Any,
    path: str | Path | None = None,
    against: str = "step",
    window: int | None = None,
    evaluations: Iterable[tuple[int, Any]] = (),
    title: str = "",
) -> Picture:
    """Draws the returns of the episodes, their moving mean, the records and, if known, the success rate below.

    Args:
        history: ``agent.history``.
        path: file to write, in the format of its suffix (``.png``, ``.svg``, ``.pdf``); None for none.
        against: ``"step"`` or ``"seconds"``.
        window: episodes in the moving mean; None for a fifth of the run, at least 3 and at most 50, or more in a run of more
            than 20,000 episodes.
        evaluations: steps and results of evaluations, such as the ``results`` of a callback :class:`rejeu.callbacks.Evaluate`.
        title: title of the figure, empty for none.

    Raises:
        MissingExtra: if matplotlib is not installed.
        ValueError: for another axis, or a ``window`` below 1.
    """
    choice("against", against, AXES)
    window = None if window is None else whole("window", window, least=1)
    along, unit, x_title = AXES[against]
    episodes = Table(history.to_dict())
    table = evaluation_table(evaluations, episodes)
    empty: charts.Chart = {"y": "return", "series": []}
    shown_charts = [charts.episode_chart(episodes, table, "return", window) or empty]
    if np.isfinite(history["success"]).any():
        shown_charts.append(charts.episode_chart(episodes, table, "success", window) or empty)
    rows = history.record_rows
    if len(rows):
        records = history["step"][rows], history["seconds"][rows] / 60, history["return"][rows]
        shown_charts[0]["series"].insert(1, charts.series("marks", "records", "good", *records))
        ends = np.array(shown_charts[0].get("range") or (), np.float64)
        shown_charts[0]["range"] = charts.fit(ends, np.array([history.best_return]))

    figure = drawing.make_figure("drawing a learning curve", height=6.4 if len(shown_charts) > 1 else 4.2)
    n, ratios = len(shown_charts), [3, 2][: len(shown_charts)]
    panels = figure.subplots(n, sharex=True, squeeze=False, height_ratios=ratios)[:, 0]
    for panel, chart in zip(panels, shown_charts, strict=True):
        drawing.draw(panel, chart, along, unit)
    last = max((x for series in shown_charts[0]["series"] for x in series[along] if x is not None), default=0) * unit
    panels[-1].set_xlabel(x_title)
    panels[-1].set_xlim(0, (last or 1.0) * (1 + RIGHT_MARGIN))
    drawing.add_title_and_legend(panels[0], title)
    return drawing.save(figure, path)


def evaluation(evaluation: Any, path: str | Path | None = None, title: str = "") -> Picture:
    """Draws the return of every episode, their mean and its 95 % confidence interval.

    Args:
        evaluation: the :class:`rejeu.Evaluation` that ``agent.evaluate()`` returns. If success is known, successful episodes
            are green and the others red.
        path: file to write, in the format of its suffix (``.png``, ``.svg``, ``.pdf``); None for none.
        title: title of the figure, empty for none.

    Raises:
        MissingExtra: if matplotlib is not installed.
    """
    figure = drawing.make_figure("drawing an evaluation")
    panel = figure.subplots()
    returns, successes = evaluation.returns, evaluation.successes
    numbers = np.arange(1, len(returns) + 1)
    low, high = evaluation.return_interval
    if math.isfinite(low):
        panel.axhspan(low, high, color=drawing.LINE_COLOR, alpha=0.15, linewidth=0, label="95 % CI")
    mean = f"mean {drawing.thousands(round(evaluation.mean_return, 2))}"
    panel.axhline(evaluation.mean_return, label=mean, zorder=3, **drawing.LINE)
    for mask, marker, color, label in (
        (np.isnan(successes), "o", drawing.DOT_COLOR, "episodes"),
        (successes == 1, "o", drawing.GOOD_COLOR, f"success ({np.sum(successes == 1):,})"),
        (successes == 0, "X", drawing.BAD_COLOR, f"no success ({np.sum(successes == 0):,})"),
    ):
        if mask.any():
            size = drawing.dot_size(len(returns))
            panel.plot(numbers[mask], returns[mask], marker, color=color, markersize=size, alpha=0.8, label=label)
    drawing.steps_axis(panel, len(returns) + 1)
    panel.set_xlabel("episode")
    panel.set_ylabel("return")
    panel.yaxis.set_major_formatter(drawing.thousands)
    drawing.format_axes(panel)
    drawing.add_title_and_legend(panel, title)
    return drawing.save(figure, path)


def comparison(comparison: Any, path: str | Path | None = None) -> Picture:
    """Draws the curves of a :class:`rejeu.lab.reporting.comparison.Comparison`.

    Args:
        comparison: the comparison.
        path: file to write, in the format of its suffix; None for none.

    Raises:
        MissingExtra: if matplotlib is not installed.
    """
    envs = list(dict.fromkeys(group.env_id for group in comparison.groups))[:MAX_PANELS]
    drawn = [charts.group_chart("curve", comparison, env) for env in envs]
    names = [
        [series["name"] for series in chart["series"] if series["name"] and series["kind"] == "line"] for chart in drawn
    ]
    heights = [3.7 + 0.2 * math.ceil(len(labels) / drawing.legend_columns(labels)) for labels in names]
    figure = drawing.make_figure("drawing a comparison", height=0.6 + sum(heights))
    panels = figure.subplots(len(envs), squeeze=False, height_ratios=heights)[:, 0]
    for panel, env, chart in zip(panels, envs, drawn, strict=True):
        drawing.draw(panel, chart)
        panel.set_xlabel(chart["x"])
        drawing.add_title_and_legend(panel, drawing.literal(env))
    return drawing.save(figure, path)


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

    description = "drawing a trajectory"
    if dimension == 1:
        figure = drawing.make_figure(description)
        panel = figure.subplots()
        _coordinate(panel, points[:, 0], lows[0], highs[0], names[0])
        panel.set_xlabel("step")
        drawing.add_title_and_legend(panel, title)
    elif dimension == 2:
        figure = drawing.make_figure(description, 5.6, 5.6)
        _plane(figure.subplots(), points, lows, highs, names, title)
    else:
        figure = drawing.make_figure(description, 10.0, 5.6)
        left_figure, right = figure.subfigures(1, 2, squeeze=False, width_ratios=[5.6, 4.4])[0]
        _plane(left_figure.subplots(), points, lows, highs, names, title)
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
