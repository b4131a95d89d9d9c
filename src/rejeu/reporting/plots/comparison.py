"""Figure of a comparison: the curves of all groups with their intervals, one panel for each environment."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rejeu.reporting.plots import style

if TYPE_CHECKING:
    from rejeu.reporting.figures import Picture

COLORS = ("#1d4f91", "#dd6b20", "#26966a", "#8a4fbe", "#cd3e34", "#0f8b9d", "#b8860b", "#64707d")
"""Colors of the groups; further groups repeat them with dashes."""
MAX_PANELS = 12
NAMES = {"iqm": "interquartile mean", "mean": "mean", "median": "median"}


def plot(comparison: Any, path: str | Path | None = None) -> Picture:
    """Draws the curves of a :class:`rejeu.reporting.comparison.Comparison`.

    Args:
        comparison: the comparison.
        path: file to write, in the format of its suffix; None for none.

    Raises:
        MissingExtra: if matplotlib is not installed.
    """
    envs = list(dict.fromkeys(group.env_id for group in comparison.groups))[:MAX_PANELS]
    labels = list(dict.fromkeys(group.label for group in comparison.groups))
    names = [[name_of(group) for group in comparison.groups if group.env_id == env] for env in envs]
    heights = [3.7 + 0.2 * math.ceil(len(one) / style.legend_columns(one)) for one in names]
    figure = style.make_figure("drawing a comparison", height=0.6 + sum(heights))
    panels = figure.subplots(len(envs), squeeze=False, height_ratios=heights)[:, 0]
    for panel, env in zip(panels, envs, strict=True):
        for group in comparison.groups:
            if group.env_id != env:
                continue
            place = labels.index(group.label)
            color, dash = COLORS[place % len(COLORS)], "-" if place < len(COLORS) else "--"
            value, low, high = group.curve
            panel.plot(group.x, value, dash, label=name_of(group), **{**style.LINE, "color": color})
            known = np.isfinite(low) & np.isfinite(high)
            panel.fill_between(group.x[known], low[known], high[known], color=color, alpha=0.15, linewidth=0)
        panel.xaxis.set_major_formatter(style.thousands)
        panel.yaxis.set_major_formatter(style.thousands)
        panel.set_xlabel({"steps": "environment steps", "time": "seconds of training"}[comparison.axis])
        panel.set_ylabel(f"return, {NAMES[comparison.statistic]}")
        style.format_axes(panel)
        style.add_title_and_legend(panel, literal(env))
    return style.save(figure, path)


def name_of(group: Any) -> str:
    """Returns the name of a group in the legend: its label and the number of its runs."""
    return literal(f"{group.label} ({len(group.runs)})")


def literal(text: str) -> str:
    """Returns text that matplotlib does not take for mathematics."""
    return text.replace("$", r"\$")
