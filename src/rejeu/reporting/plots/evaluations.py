"""Figure of an evaluation: returns, their mean and its confidence interval."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rejeu.reporting.plots import drawing

if TYPE_CHECKING:
    from rejeu.reporting.plots.picture import Picture


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
    panel.axhline(
        evaluation.mean_return,
        label=f"mean {drawing.thousands(round(evaluation.mean_return, 2))}",
        zorder=3,
        **drawing.LINE,
    )
    for chosen, marker, color, label in (
        (np.isnan(successes), "o", drawing.DOT_COLOR, "episodes"),
        (successes == 1, "o", drawing.GOOD_COLOR, f"success ({np.sum(successes == 1):,})"),
        (successes == 0, "X", drawing.BAD_COLOR, f"no success ({np.sum(successes == 0):,})"),
    ):
        if chosen.any():
            size = drawing.dot_size(len(returns))
            panel.plot(numbers[chosen], returns[chosen], marker, color=color, markersize=size, alpha=0.8, label=label)
    drawing.steps_axis(panel, len(returns) + 1)
    panel.set_xlabel("episode")
    panel.set_ylabel("return")
    panel.yaxis.set_major_formatter(drawing.thousands)
    drawing.format_axes(panel)
    drawing.add_title_and_legend(panel, title)
    return drawing.save(figure, path)
