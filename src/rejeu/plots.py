"""Pictures of training runs. Drawn without a display and without matplotlib's global state."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rejeu.config import whole
from rejeu.errors import MissingExtra
from rejeu.evaluation import Evaluation

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rejeu.figures import Picture
    from rejeu.history import History

INK, MUTED, GRID = "#1f2933", "#7b8794", "#e4e7eb"
EPISODES = "episodes"
DOT_COLOUR, LINE_COLOUR, EVALUATION_COLOUR = "#63a4e0", "#1d4f91", "#dd6b20"
AXIS_LABELS = {"step": "environment steps", "seconds": "seconds of training"}
MOST_WINDOW = 50
"""Most episodes in the moving average that is drawn by default."""
TITLE_WIDTH = 72
"""Characters of a title's line: what fits the width of the picture in the title's font."""
ROOM_AT_THE_RIGHT = 0.02
"""Of the horizontal axis, beyond the last episode, so that its dot is drawn whole."""


def learning_curve(
    history: History,
    path: str | Path | None = None,
    against: str = "step",
    window: int | None = None,
    evaluations: Iterable[tuple[int, Evaluation]] = (),
    title: str = "",
) -> Picture:
    """Draws the return of every episode, its moving average and, where known, the success rate below.

    Args:
        history: the episodes; may be empty.
        path: of a file to write, whose suffix says the format (``.png``, ``.svg``, ``.pdf``); None for none.
        against: ``"step"`` or ``"seconds"``.
        window: episodes in the moving average; None: a fifth of the run, at least 3 and at most 50. The legend says it.
        evaluations: ``(step, Evaluation)`` pairs, such as ``Evaluate.results``, drawn as points with 95 % intervals.
        title: over the picture; long ones are wrapped. Empty for none.

    Raises:
        MissingExtra: if matplotlib is not installed.
        ValueError: for another ``against`` or a ``window`` below 1.
    """
    try:
        from matplotlib.ticker import FuncFormatter, PercentFormatter

        from rejeu.figures import Picture
    except ImportError:
        raise MissingExtra("drawing a learning curve", "matplotlib", "plot") from None
    if against not in AXIS_LABELS:
        raise ValueError(f"against={against!r} must be one of {', '.join(AXIS_LABELS)}")
    window = default_window(len(history)) if window is None else whole("window", window, least=1)
    evaluations = list(evaluations)
    x, returns, successes = history[against], history["return"], history["success"]
    steps = np.array([step for step, _ in evaluations], np.float64)
    at = steps if against == "step" or not len(x) else np.interp(steps, history["step"], x)
    has_success = bool(np.isfinite(successes).any())

    figure = Picture(figsize=(8.0, 6.4 if has_success else 4.2), dpi=150, layout="constrained", facecolor="white")
    panels = figure.subplots(1 + has_success, sharex=True, squeeze=False, height_ratios=[3, 2][: 1 + has_success])[:, 0]
    means = [evaluation.mean_return for _, evaluation in evaluations]
    _episodes(panels[0], x, returns)
    _line(panels[0], x, history.moving_average("return", window), window)
    _points(panels[0], at, means, [evaluation.return_interval for _, evaluation in evaluations])
    _fit(panels[0], returns, means)
    panels[0].set_ylabel("return")
    panels[0].yaxis.set_major_formatter(FuncFormatter(_thousands))
    if has_success:
        rates = [evaluation.success_rate for _, evaluation in evaluations]
        _line(panels[1], x, history.moving_average("success", window), window)
        _points(panels[1], at, rates, [evaluation.success_interval for _, evaluation in evaluations])
        panels[1].set_ylim(-0.03, 1.03)
        panels[1].set_ylabel("success rate")
        panels[1].yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    for panel in panels:
        _dress(panel)
    panels[-1].set_xlabel(AXIS_LABELS[against])
    panels[-1].xaxis.set_major_formatter(FuncFormatter(_thousands))
    panels[-1].set_xlim(0, max([*x[-1:], *at[-1:], 1e-9]) * (1 + ROOM_AT_THE_RIGHT))
    _head(panels[0], title)
    if path is not None:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)
    return figure


def default_window(n_episodes: int) -> int:
    """Returns the episodes in the moving average of a run: few in a short one, whose line would lag behind otherwise.

    >>> [default_window(n) for n in (4, 30, 100, 1000)]
    [3, 6, 20, 50]
    """
    return min(max(n_episodes // 5, 3), MOST_WINDOW)


def _head(panel: Axes, title: str) -> None:
    """Writes the legend above a panel and the title above the legend, so that neither limits the other's length."""
    has_legend = bool(panel.get_legend_handles_labels()[0])
    if title:
        text = "\n".join(textwrap.wrap(title, TITLE_WIDTH))
        panel.set_title(text, loc="left", color=INK, fontsize=12, fontweight="bold", pad=25 if has_legend else 9)
    if has_legend:
        style = {"frameon": False, "fontsize": 8.5, "labelcolor": INK, "handlelength": 1.2, "columnspacing": 1.4}
        legend = panel.legend(loc="lower left", bbox_to_anchor=(-0.01, 1.0), ncols=3, borderaxespad=0.2, **style)
        for line in legend.get_lines():
            if line.get_label() == EPISODES:
                line.set(markersize=5, alpha=0.8)


def _thousands(value: float, _: int | None = None) -> str:
    return f"{value:,.10g}".replace("-", "\N{MINUS SIGN}")


def _episodes(panel: Axes, x: np.ndarray, y: np.ndarray) -> None:
    """Draws each episode as a dot, smaller and lighter the more there are."""
    if not len(x):
        return
    size = float(np.clip(60 / math.sqrt(len(x)), 2.4, 5.0))
    opacity = float(np.clip(600 / len(x), 0.3, 0.6))
    panel.plot(x, y, "o", markersize=size, color=DOT_COLOUR, alpha=opacity, markeredgewidth=0, label=EPISODES)


def _line(panel: Axes, x: np.ndarray, y: np.ndarray, window: int) -> None:
    if len(x):
        style: dict[str, Any] = {"solid_capstyle": "round", "solid_joinstyle": "round"}
        panel.plot(x, y, color=LINE_COLOUR, linewidth=1.8, label=f"mean of {window} episodes", **style)


def _points(panel: Axes, x: np.ndarray, y: list[float], intervals: list[tuple[float, float]]) -> None:
    """Draws evaluations as points with their intervals as bars; an unknown interval has no bar."""
    if not len(x) or not np.isfinite(y).any():
        return
    low, high = np.array(intervals).T
    reach = np.nan_to_num(np.stack([np.array(y) - low, high - np.array(y)]).clip(0))
    panel.errorbar(x, y, reach, fmt="none", ecolor=EVALUATION_COLOUR, elinewidth=1.2, alpha=0.6, zorder=3)
    style: dict[str, Any] = {
        "color": EVALUATION_COLOUR,
        "markeredgecolor": "white",
        "markeredgewidth": 0.8,
        "zorder": 4,
    }
    panel.plot(x, y, "o", markersize=5, label="evaluation, 95 % interval", clip_on=False, **style)


def _fit(panel: Axes, returns: np.ndarray, evaluated: list[float]) -> None:
    """Fits the height to all but the most extreme half percent of returns on either side, and to all evaluations."""
    shown = np.concatenate([np.quantile(returns, [0.005, 0.995]) if len(returns) else [], evaluated])
    shown = shown[np.isfinite(shown)]
    if len(shown):
        margin = 0.05 * (np.ptp(shown) or 1.0)
        panel.set_ylim(shown.min() - margin, shown.max() + margin)


def _dress(panel: Axes) -> None:
    panel.grid(color=GRID, linewidth=0.8)
    panel.set_axisbelow(True)
    panel.spines[["top", "right", "left"]].set_visible(False)
    panel.spines["bottom"].set_color(MUTED)
    panel.tick_params(colors=MUTED, labelcolor=INK, labelsize=9, length=0, pad=6)
    panel.xaxis.label.set(color=INK, fontsize=10)
    panel.yaxis.label.set(color=INK, fontsize=10)
