"""Figure of an evaluation: returns, their mean and its confidence interval."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from rejeu.reporting.plots import style

if TYPE_CHECKING:
    from rejeu.reporting.figures import Picture


class Evaluated(Protocol):
    """The attributes of an :class:`rejeu.Evaluation` that are drawn."""

    @property
    def returns(self) -> np.ndarray: ...
    @property
    def successes(self) -> np.ndarray: ...
    @property
    def mean_return(self) -> float: ...
    @property
    def return_interval(self) -> tuple[float, float]: ...
    @property
    def success_rate(self) -> float: ...
    @property
    def success_interval(self) -> tuple[float, float]: ...


def evaluation(evaluation: Evaluated, path: str | Path | None = None, title: str = "") -> Picture:
    """Draws the return of every episode, their mean and its 95 % confidence interval.

    Args:
        evaluation: result of ``agent.evaluate()``. If success is known, successful episodes are green and the others
            red.
        path: file to write, in the format of its suffix (``.png``, ``.svg``, ``.pdf``); None for none.
        title: title of the figure, empty for none.

    Raises:
        MissingExtra: if matplotlib is not installed.
    """
    figure = style.make_figure("drawing an evaluation")
    panel = figure.subplots()
    returns, successes = evaluation.returns, evaluation.successes
    numbers = np.arange(1, len(returns) + 1)
    low, high = evaluation.return_interval
    if math.isfinite(low):
        panel.axhspan(low, high, color=style.LINE_COLOR, alpha=0.15, linewidth=0, label="95 % CI")
    panel.axhline(
        evaluation.mean_return,
        label=f"mean {style.thousands(round(evaluation.mean_return, 2))}",
        zorder=3,
        **style.LINE,
    )
    for chosen, marker, color, label in (
        (np.isnan(successes), "o", style.DOT_COLOR, "episodes"),
        (successes == 1, "o", style.GOOD_COLOR, f"success ({np.sum(successes == 1):,})"),
        (successes == 0, "X", style.BAD_COLOR, f"no success ({np.sum(successes == 0):,})"),
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
    style.format_axes(panel)
    style.add_title_and_legend(panel, title)
    return style.save(figure, path)
