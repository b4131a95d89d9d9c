"""An evaluation: the return of every episode, their mean and how sure it is."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rejeu.reporting.plots import style

if TYPE_CHECKING:
    from rejeu.reporting.evaluation import Evaluation
    from rejeu.reporting.figures import Picture


def evaluation(evaluation: Evaluation, path: str | Path | None = None, title: str = "") -> Picture:
    """Draws the return of every episode of an evaluation, their mean and its 95 % interval.

    Args:
        evaluation: what ``agent.evaluate()`` returned. Where it knows which episodes succeeded, these are green and the
            others red.
        path: of a file to write, whose suffix says the format (``.png``, ``.svg``, ``.pdf``); None for none.
        title: over the picture; empty for none.

    Raises:
        MissingExtra: if matplotlib is not installed.
    """
    figure = style.blank("drawing an evaluation")
    panel = figure.subplots()
    returns, successes = evaluation.returns, evaluation.successes
    numbers = np.arange(1, len(returns) + 1)
    low, high = evaluation.return_interval
    if math.isfinite(low):
        panel.axhspan(low, high, color=style.LINE_COLOR, alpha=0.15, linewidth=0, label="95 % interval")
    panel.axhline(
        evaluation.mean_return,
        label=f"mean {style.thousands(round(evaluation.mean_return, 2))}",
        zorder=3,
        **style.LINE,
    )
    for chosen, marker, color, label in (
        (np.isnan(successes), "o", style.DOT_COLOR, "episodes"),
        (successes == 1, "o", style.GOOD_COLOR, f"success ({np.sum(successes == 1)})"),
        (successes == 0, "X", style.BAD_COLOR, f"no success ({np.sum(successes == 0)})"),
    ):
        if chosen.any():
            size = float(np.clip(60 / math.sqrt(len(returns)), 2.4, 5.0))
            panel.plot(numbers[chosen], returns[chosen], marker, color=color, markersize=size, alpha=0.8, label=label)
    panel.set_xlabel("episode")
    panel.set_ylabel("return")
    panel.set_xlim(0, len(returns) + 1)
    panel.locator_params(axis="x", integer=True)
    panel.xaxis.set_major_formatter(style.thousands)
    panel.yaxis.set_major_formatter(style.thousands)
    style.dress(panel)
    style.head(panel, title)
    return style.write(figure, path)
