"""Figures: their common style (colors, fonts, grid, title, legend), and charts drawn by matplotlib."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rejeu.core import atomic
from rejeu.core.errors import requires
from rejeu.core.types import Settings
from rejeu.logs.charts import GROUP_COLORS, Chart

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rejeu.logs.plots.picture import Picture

INK, MUTED, GRID = "#1f2933", "#7b8794", "#e4e7eb"
DOT_COLOR, LINE_COLOR, ACCENT_COLOR, GOOD_COLOR, BAD_COLOR = "#63a4e0", "#1d4f91", "#dd6b20", "#26966a", "#cd3e34"
COLORS = {"dots": DOT_COLOR, "line": LINE_COLOR, "accent": ACCENT_COLOR, "good": GOOD_COLOR, "bad": BAD_COLOR}
COLORS |= {f"group{i}": light for i, (light, _) in enumerate(GROUP_COLORS)}
"""Colors by their names in a chart."""
LINE: Settings = {"color": LINE_COLOR, "linewidth": 1.8, "solid_capstyle": "round", "solid_joinstyle": "round"}
WIDTH = 8.0
"""Default width of a figure in inches."""
TITLE_CHARACTERS, LEGEND_CHARACTERS = 7.5, 13.5
"""Characters in an inch of the title and of the legend."""
LEGEND_COLUMNS = 4
"""Maximum number of columns of a legend."""


def make_figure(drawing: str, width: float = WIDTH, height: float = 4.2) -> Picture:
    """Returns an empty figure with a size in inches.

    Raises:
        MissingExtra: if matplotlib is not installed. The message says that ``drawing`` needs it.
    """
    with requires(drawing, "matplotlib", "plot"):
        import matplotlib.figure  # noqa: F401 - also where our own module was imported before

        from rejeu.logs.plots.picture import Picture
    return Picture(figsize=(width, height), dpi=150, layout="constrained", facecolor="white")


def save(figure: Picture, path: str | Path | None) -> Picture:
    """Writes the figure to ``path``, if there is one, in the format of its suffix, and returns the figure."""
    if path is not None:
        path = Path(path)
        path = path if path.suffix else path.with_name(f"{path.name}.png")
        with atomic.replacing(path) as file:
            figure.savefig(file, format=path.suffix[1:])
    return figure


def draw(panel: Axes, chart: Chart, along: str = "x", unit: float = 1.0) -> None:
    """Draws a chart into a panel.

    Args:
        panel: the panel.
        chart: what :mod:`rejeu.logs.charts` returns.
        along: "x" for steps, "t" for minutes.
        unit: factor of the horizontal axis, such as 60 for seconds.
    """
    labels_drawn: list[str] = []
    for series in chart["series"]:
        x = np.array(series[along], np.float64) * unit
        y, low, high = (np.array(series.get(name, ()), np.float64) for name in ("y", "low", "high"))
        color, label = COLORS[series["color"]], literal(series["name"]) or None
        if series["kind"] == "dots":
            size, opacity = dot_size(len(x)), float(np.clip(600 / len(x), 0.3, 0.6))
            panel.plot(x, y, "o", markersize=size, color=color, alpha=opacity, markeredgewidth=0, label=label)
        elif series["kind"] == "thin":
            panel.plot(x, y, color=color, linewidth=0.7, alpha=0.35)
        elif series["kind"] == "marks":
            panel.plot(x, y, "^", markersize=4.5, color=color, label=label, zorder=3)
        elif series["kind"] == "band":
            is_known = np.isfinite(low) & np.isfinite(high)
            panel.fill_between(x[is_known], low[is_known], high[is_known], color=color, alpha=0.15, linewidth=0)
        elif series["kind"] == "points":
            reach = np.nan_to_num(np.stack([y - low, high - y]).clip(0))
            panel.errorbar(x, y, reach, fmt="none", ecolor=color, elinewidth=1.2, alpha=0.6, zorder=3)
            edge: Settings = {"markeredgecolor": "white", "markeredgewidth": 0.8, "zorder": 4}
            panel.plot(x, y, "o", markersize=5, color=color, label=label, clip_on=False, **edge)
        else:
            dash = "--" if labels_drawn.count(color) else "-"  # more groups than colors
            panel.plot(x, y, dash, label=label, **{**LINE, "color": color})
            labels_drawn.append(color)
    if chart.get("range") is not None:
        panel.set_ylim(*chart["range"])
    panel.set_ylabel(chart["y"])
    panel.xaxis.set_major_formatter(thousands)
    panel.yaxis.set_major_formatter("{x:.0%}" if chart.get("percent") else thousands)
    format_axes(panel)


def dot_size(n: int) -> float:
    """Returns the size of one of ``n`` dots, in points: more are smaller."""
    return float(np.clip(60 / max(n, 1) ** 0.5, 2.4, 5.0))


def literal(text: str) -> str:
    """Returns text that matplotlib does not take for mathematics."""
    return text.replace("$", r"\$")


def steps_axis(panel: Axes, n_steps: int) -> None:
    """Gives a panel a horizontal axis of whole steps from 0."""
    panel.set_xlabel("step")
    panel.set_xlim(0, n_steps)
    panel.locator_params(axis="x", integer=True)
    panel.xaxis.set_major_formatter(thousands)


def format_axes(panel: Axes) -> None:
    """Sets grid, spines and font sizes of a panel."""
    panel.grid(color=GRID, linewidth=0.8)
    panel.set_axisbelow(True)
    panel.spines[["top", "right", "left"]].set_visible(False)
    panel.spines["bottom"].set_color(MUTED)
    panel.tick_params(colors=MUTED, labelcolor=INK, labelsize=9, length=0, pad=6)
    panel.xaxis.label.set(color=INK, fontsize=10)
    panel.yaxis.label.set(color=INK, fontsize=10)


def add_title_and_legend(panel: Axes, title: str) -> None:
    """Writes the legend above a panel and the title above the legend."""
    handles, labels = panel.get_legend_handles_labels()
    width = panel.figure.bbox.width / panel.figure.dpi
    title = textwrap.fill(title, round(TITLE_CHARACTERS * width))
    if not labels:
        panel.set_title(title, loc="left", color=INK, fontsize=12, fontweight="bold", pad=9)
        return
    labels = [textwrap.fill(label, round(LEGEND_CHARACTERS * width)) for label in labels]
    style: Settings = {"frameon": False, "fontsize": 8.5, "labelcolor": INK, "handlelength": 1.2}
    position: Settings = {"loc": "lower left", "bbox_to_anchor": (-0.01, 1.0), "borderaxespad": 0.2}
    heading: Settings = {"title": title, "alignment": "left", "title_fontproperties": {"size": 12, "weight": "bold"}}
    legend = panel.legend(
        handles, labels, ncols=legend_columns(labels, width), columnspacing=1.4, **style, **position, **heading
    )
    legend.get_title().set_color(INK)
    for line in legend.get_lines():  # as large whatever the number of episodes
        if line.get_marker() == "o" and line.get_alpha() is not None:
            line.set(markersize=5, alpha=0.8)


def legend_columns(labels: Sequence[str], width: float = WIDTH) -> int:
    """Returns the number of columns in which the labels of a legend fit into a width in inches.

    >>> legend_columns(["episodes", "mean of 50 episodes"]), legend_columns(["batch_size=64, learning_rate=0.001 (5)"])
    (4, 2)
    """
    longest = max((len(line) for label in labels for line in label.splitlines()), default=0)
    return min(max(int(LEGEND_CHARACTERS * width / (longest + 6)), 1), LEGEND_COLUMNS)


def thousands(value: float, _: float | None = None) -> str:
    """Formats a number with thousands separators and a typographic minus sign.

    >>> thousands(12500.0)
    '12,500'
    """
    return f"{value:,.10g}".replace("-", "\N{MINUS SIGN}")
