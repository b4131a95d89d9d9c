"""Learning curve: returns and success rates of a run against steps or seconds."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from rejeu.reporting.plots import style
from rejeu.reporting.plots.evaluations import Evaluated
from rejeu.validation import whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rejeu.reporting.figures import Picture

EPISODES = "episodes"
AXIS_LABELS = {"step": "environment steps", "seconds": "seconds of training"}
MAX_WINDOW = 50
"""Maximum default number of episodes in the moving average."""
RIGHT_MARGIN = 0.02
"""Share of the horizontal axis beyond the last episode."""


class Episodes(Protocol):
    """The attributes of an ``agent.history`` that are drawn."""

    best_return: float

    @property
    def record_rows(self) -> np.ndarray: ...
    def __len__(self) -> int: ...
    def __getitem__(self, column: str) -> np.ndarray: ...
    def moving_average(self, column: str = ..., window: int = ...) -> np.ndarray: ...


def learning_curve(
    history: Episodes,
    path: str | Path | None = None,
    against: str = "step",
    window: int | None = None,
    evaluations: Iterable[tuple[int, Evaluated]] = (),
    title: str = "",
) -> Picture:
    """Draws the return of every episode, the moving average, the records and, if known, the success rate below.

    A record is an episode with a higher return than all before it.

    Args:
        history: the episodes, such as ``agent.history``; may be empty.
        path: file to write, in the format of its suffix (``.png``, ``.svg``, ``.pdf``); None for none.
        against: ``"step"`` or ``"seconds"``.
        window: episodes in the moving average; None for a fifth of the run, at least 3 and at most 50.
        evaluations: ``(step, Evaluation)`` pairs, such as ``Evaluate.results``, drawn as points with error bars.
        title: title of the figure, which is wrapped; empty for none.

    Raises:
        MissingExtra: if matplotlib is not installed.
        ValueError: for another ``against`` or a ``window`` below 1.
    """
    if against not in AXIS_LABELS:
        raise ValueError(f"against={against!r} must be one of {', '.join(AXIS_LABELS)}")
    window = default_window(len(history)) if window is None else whole("window", window, least=1)
    evaluations = list(evaluations)
    x, returns, successes = history[against], history["return"], history["success"]
    steps = np.array([step for step, _ in evaluations], np.float64)
    at = steps if against == "step" or not len(x) else np.interp(steps, history["step"], x)
    has_success = bool(np.isfinite(successes).any())

    figure = style.make_figure("drawing a learning curve", height=6.4 if has_success else 4.2)
    panels = figure.subplots(1 + has_success, sharex=True, squeeze=False, height_ratios=[3, 2][: 1 + has_success])[:, 0]
    means = [evaluation.mean_return for _, evaluation in evaluations]
    _episodes(panels[0], x, returns)
    _records(panels[0], x, returns, history.record_rows)
    _line(panels[0], x, history.moving_average("return", window), window)
    intervals = [evaluation.return_interval for _, evaluation in evaluations]
    _points(panels[0], at, means, intervals)
    _fit(panels[0], returns, [*means, *chain.from_iterable(intervals), history.best_return])
    panels[0].set_ylabel("return")
    panels[0].yaxis.set_major_formatter(style.thousands)
    if has_success:
        rates = [evaluation.success_rate for _, evaluation in evaluations]
        _line(panels[1], x, history.moving_average("success", window), window)
        _points(panels[1], at, rates, [evaluation.success_interval for _, evaluation in evaluations])
        panels[1].set_ylim(-0.03, 1.03)
        panels[1].set_ylabel("success rate")
        panels[1].yaxis.set_major_formatter(lambda share, _: f"{share:.0%}")
    for panel in panels:
        style.format_axes(panel)
    panels[-1].set_xlabel(AXIS_LABELS[against])
    panels[-1].xaxis.set_major_formatter(style.thousands)
    panels[-1].set_xlim(0, (max([*x[-1:], *at[-1:]], default=0.0) or 1.0) * (1 + RIGHT_MARGIN))
    style.add_title_and_legend(panels[0], title)
    _enlarge_dots(panels[0])
    return style.save(figure, path)


def default_window(n_episodes: int) -> int:
    """Returns the default number of episodes in the moving average.

    >>> [default_window(n) for n in (4, 30, 100, 1000)]
    [3, 6, 20, 50]
    """
    return min(max(n_episodes // 5, 3), MAX_WINDOW)


def _enlarge_dots(panel: Axes) -> None:
    """Sets the size of the dot in the legend, independent of the number of episodes."""
    legend = panel.get_legend()
    for line in legend.get_lines() if legend is not None else ():
        if line.get_label() == EPISODES:
            line.set(markersize=5, alpha=0.8)


def _episodes(panel: Axes, x: np.ndarray, y: np.ndarray) -> None:
    """Draws each episode as a dot. More episodes have smaller and lighter dots."""
    if not len(x):
        return
    size = float(np.clip(60 / math.sqrt(len(x)), 2.4, 5.0))
    opacity = float(np.clip(600 / len(x), 0.3, 0.6))
    panel.plot(x, y, "o", markersize=size, color=style.DOT_COLOR, alpha=opacity, markeredgewidth=0, label=EPISODES)


def _records(panel: Axes, x: np.ndarray, returns: np.ndarray, rows: np.ndarray) -> None:
    """Marks the episodes with a higher return than all before them."""
    if len(rows):
        panel.plot(x[rows], returns[rows], "^", markersize=4.5, color=style.GOOD_COLOR, label="records", zorder=3)


def _line(panel: Axes, x: np.ndarray, y: np.ndarray, window: int) -> None:
    if len(x):
        panel.plot(x, y, label=f"mean of {window} episodes", **style.LINE)


def _points(panel: Axes, x: np.ndarray, y: list[float], intervals: list[tuple[float, float]]) -> None:
    """Draws evaluations as points with error bars, if the intervals are known."""
    if not len(x) or not np.isfinite(y).any():
        return
    low, high = np.array(intervals).T
    reach = np.nan_to_num(np.stack([np.array(y) - low, high - np.array(y)]).clip(0))
    panel.errorbar(x, y, reach, fmt="none", ecolor=style.ACCENT_COLOR, elinewidth=1.2, alpha=0.6, zorder=3)
    form: dict[str, Any] = {
        "color": style.ACCENT_COLOR,
        "markeredgecolor": "white",
        "markeredgewidth": 0.8,
        "zorder": 4,
    }
    panel.plot(x, y, "o", markersize=5, label="evaluation, 95 % CI", clip_on=False, **form)


def _fit(panel: Axes, returns: np.ndarray, further: list[float]) -> None:
    """Fits the vertical axis to all but the extreme half percent of returns, and to other values."""
    shown = np.concatenate([np.quantile(returns, [0.005, 0.995]) if len(returns) else [], further])
    shown = shown[np.isfinite(shown)]
    if len(shown):
        margin = 0.05 * (np.ptp(shown) or max(abs(shown[0]), 1.0))
        panel.set_ylim(shown.min() - margin, shown.max() + margin)
