"""Figures of the performance page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from benchmarks.bench import plan
from benchmarks.bench.summary import Limit, Spread

COLORS = {"rejeu": "#0b6e99", "rejeu, EnvPool": "#15b097", "sb3": "#e07b39", "sbx": "#9b59b6", "limit": "#444444"}
NAMES = {"rejeu": "rejeu", "sb3": "Stable-Baselines3", "sbx": "SBX"}
STYLE = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "figure.dpi": 130,
}


def number(value: float, _: Any = None) -> str:
    """Formats a number with three significant figures.

    >>> [number(x) for x in (0.1234, 2.5, 1234.0)]
    ['0.123', '2.5', '1,234']
    """
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def draw_steps(
    seconds: Mapping[str, Mapping[str, Spread]], limits: Mapping[str, Limit | None], path: Path, title: str
) -> None:
    """Plots milliseconds per step as bars by case and library, ranges as whiskers and rejeu's limits as lines."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(9, 4.4), layout="constrained")
        width = 0.26
        for i, library in enumerate(plan.LIBRARIES):
            places, heights, low, high = [], [], [], []
            for place, by in enumerate(seconds.values()):
                if library in by:
                    found = by[library]
                    places.append(place + (i - 1) * width)
                    heights.append(1e3 * found.median)
                    low.append(1e3 * (found.median - found.low))
                    high.append(1e3 * (found.high - found.median))
            if places:
                axes.bar(places, heights, width, color=COLORS[library], label=NAMES[library])
                axes.errorbar(places, heights, [low, high], fmt="none", ecolor="black", elinewidth=0.8, capsize=2)
                for place, height, above in zip(places, heights, high, strict=True):
                    above_it = {"xytext": (0, 2), "textcoords": "offset points", "ha": "center", "fontsize": 7}
                    axes.annotate(number(height), (place, height + above), **above_it)
        labelled = False
        for place, name in enumerate(seconds):
            found = limits.get(name)
            if found is not None:
                left = place - 1.65 * width
                label = None if labelled else "limit: bare environment and arithmetic"
                right = left + 1.3 * width
                axes.hlines(1e3 * found.seconds, left, right, color="black", linewidth=2.2, label=label, zorder=3)
                labelled = True
        axes.set_yscale("log")
        logarithmic(axes.yaxis)
        axes.grid(axis="x", visible=False)
        axes.set_xticks(range(len(seconds)), [name.replace(", ", "\n") for name in seconds])
        axes.set_ylabel("milliseconds per step (log), less is better")
        axes.set_title(title, loc="left")
        axes.legend(loc="upper left", ncols=4, fontsize=8)
        axes.margins(y=0.15)
        save(figure, path)


def draw_rollouts(
    rates: Mapping[str, Mapping[str, Mapping[int, Spread]]],
    limits: Mapping[str, Mapping[str, Mapping[int, float]]],
    path: Path,
    title: str,
) -> None:
    """Plots steps per second against the number of environments, with one panel per algorithm.

    Args:
        rates: steps per second by algorithm, by line (``rejeu``, ``rejeu, EnvPool``, ``sb3``, ``sbx``) and by number
            of environments.
        limits: limits in the same structure, plotted as dashed lines.
        path: path of the image.
        title: title of the figure.
    """
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(1, len(rates), figsize=(9, 4), layout="constrained", squeeze=False)
        for axes, (algorithm, lines) in zip(panels[0], rates.items(), strict=True):
            for line, by in lines.items():
                draw_line(axes, by, COLORS[line], NAMES.get(line, line))
            for line, at in limits.get(algorithm, {}).items():
                axes.plot(list(at), list(at.values()), "--", color=COLORS[line], linewidth=1, alpha=0.8)
            axes.plot([], [], "--", color=COLORS["limit"], linewidth=1, label="limit, of the same color")
            axes.set_xscale("log", base=2)
            axes.set_yscale("log")
            axes.set_xticks(plan.N_ENVS, [str(n) for n in plan.N_ENVS])
            logarithmic(axes.yaxis)
            axes.set_xlabel("environments")
            axes.set_title(algorithm, loc="left")
        panels[0][0].set_ylabel("environment steps per second (log), more is better")
        panels[0][0].legend(fontsize=8, frameon=True, framealpha=0.9, edgecolor="none")
        figure.suptitle(title, x=0.01, ha="left")
        save(figure, path)


def draw_replay(seconds: Mapping[str, Mapping[int, Spread]], path: Path, title: str) -> None:
    """Plots microseconds per batch against the buffer size. Lines of Stable-Baselines3 start with ``sb3``."""
    colors = {"rejeu, hindsight": "#0b6e99", "sb3, hindsight": "#e07b39", "rejeu, priority": "#15b097"}
    labels = {
        "rejeu, hindsight": "rejeu, hindsight",
        "sb3, hindsight": "Stable-Baselines3, hindsight",
        "rejeu, priority": "rejeu, by priority, with the update of priorities",
    }
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
        for line, by in seconds.items():
            scaled = {size: Spread(*(1e6 * value for value in found)) for size, found in by.items()}
            draw_line(axes, scaled, colors[line], labels[line])
        axes.set_xscale("log")
        axes.set_yscale("log")
        logarithmic(axes.yaxis)
        axes.set_xlabel("transitions in the buffer (log)")
        axes.set_ylabel("microseconds per batch of 256 (log), less is better")
        axes.set_title(title, loc="left")
        axes.legend(fontsize=8)
        save(figure, path)


def logarithmic(axis: Any) -> None:
    """Labels a logarithmic axis at 1, 2 and 5 times each power of ten."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(number))


def draw_line(axes: Any, by: Mapping[int, Spread], color: str, label: str) -> None:
    """Plots medians as a line and ranges as a band."""
    places: Sequence[int] = list(by)
    axes.plot(places, [found.median for found in by.values()], "o-", color=color, label=label, markersize=4)
    low, high = ([getattr(found, end) for found in by.values()] for end in ("low", "high"))
    axes.fill_between(places, low, high, color=color, alpha=0.15, linewidth=0)


def save(figure: Any, path: Path) -> None:
    """Saves a figure and closes it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    plt.close(figure)
