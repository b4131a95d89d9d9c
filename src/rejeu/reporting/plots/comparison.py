"""Figure of a comparison: the curves of all groups with their intervals, one panel for each environment."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rejeu.reporting.charts import group_chart
from rejeu.reporting.plots import drawing

if TYPE_CHECKING:
    from rejeu.reporting.plots.picture import Picture

MAX_PANELS = 12


def plot(comparison: Any, path: str | Path | None = None) -> Picture:
    """Draws the curves of a :class:`rejeu.reporting.comparison.Comparison`.

    Args:
        comparison: the comparison.
        path: file to write, in the format of its suffix; None for none.

    Raises:
        MissingExtra: if matplotlib is not installed.
    """
    envs = list(dict.fromkeys(group.env_id for group in comparison.groups))[:MAX_PANELS]
    charts = [group_chart("curve", comparison, env) for env in envs]
    names = [[series["name"] for series in chart["series"] if series["name"]] for chart in charts]
    heights = [3.7 + 0.2 * math.ceil(len(one) / drawing.legend_columns(one)) for one in names]
    figure = drawing.make_figure("drawing a comparison", height=0.6 + sum(heights))
    panels = figure.subplots(len(envs), squeeze=False, height_ratios=heights)[:, 0]
    for panel, env, chart in zip(panels, envs, charts, strict=True):
        drawing.draw(panel, chart)
        panel.set_xlabel(chart["x"])
        drawing.add_title_and_legend(panel, drawing.literal(env))
    return drawing.save(figure, path)
