"""Curves and histograms as plain data: smoothed here, drawn by Plotly in pages and by matplotlib in pictures.

A chart is a dictionary of JSON values: titles ``x`` and ``y``, ``percent`` for shares, ``range`` of the vertical axis,
``note`` and ``series``. A series has ``kind`` ("dots", "line", "thin", "points", "band", "marks", "area" or "places"),
``name``, ``color``, ``x`` (steps), ``t`` (minutes) and ``y``, with ``low`` and ``high`` for a band or error bars.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from rejeu.logs import statistics
from rejeu.logs.formatting import counted
from rejeu.logs.tables import HUGE, Table

MAX_DOTS = 1500
"""Most episodes that are drawn one by one; of more their quantiles are drawn."""
MAX_POINTS = 400
"""Most points of a curve."""
BARS = 30
"""Bars of a histogram."""
LISTED = 40
"""Most episodes that are listed behind a bar."""
MAX_WINDOW = 50
"""Most episodes in a moving mean of a run of ordinary length."""
MAX_METRICS = 60
"""Most metrics that are drawn."""
DIGITS = 6
"""Significant digits of the numbers in a page."""

Series = dict[str, Any]
Chart = dict[str, Any]


class Smoothed(NamedTuple):
    """A series of episodes, smoothed for drawing."""

    step: np.ndarray
    minutes: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    """Lower end of the 95 % confidence interval of the mean."""
    high: np.ndarray
    spread: tuple[np.ndarray, np.ndarray] | None
    """The 5 % and 95 % quantiles around each point; None where all episodes are drawn."""


def plain(values: Iterable[float] | np.ndarray) -> list[float | None]:
    """Returns numbers for JSON: rounded unless they are whole, with None for those that are not finite.

    >>> plain([1.23456789, 12345678.0, float("nan")])
    [1.23457, 12345678.0, None]
    """
    return [
        None if not math.isfinite(value) else value if float(value).is_integer() else float(f"{value:.{DIGITS}g}")
        for value in np.asarray(values).tolist()
    ]


def usable(values: np.ndarray) -> np.ndarray:
    """Returns which numbers can be drawn, ``bool (n,)``."""
    return np.abs(values) < HUGE


def window_of(n: int) -> int:
    """Returns the number of episodes that a point of a smoothed curve averages.

    >>> [window_of(n) for n in (4, 30, 100, 1500, 1_000_000)]
    [3, 6, 20, 50, 2500]
    """
    return max(min(max(n // 5, 3), MAX_WINDOW), round(n / MAX_POINTS))


def smooth(episodes: Table, values: np.ndarray, is_rate: bool = False, window: int | None = None) -> Smoothed:
    """Returns the moving means of one column with 95 % confidence intervals, those of rates after Wilson; NaN is ignored."""
    is_known = usable(values)
    step, seconds, values = episodes.column("step")[is_known], episodes.column("seconds")[is_known], values[is_known]
    n = len(values)
    window = window_of(n) if window is None else window
    at = thinned(n) if n <= MAX_DOTS else np.unique(np.linspace(window - 1, n - 1, MAX_POINTS).astype(int))
    rows = [values[max(i + 1 - window, 0) : i + 1] for i in at]
    mean, variance, count = (np.array([function(row) for row in rows], float) for function in (np.mean, np.var, len))
    low, high = statistics.wilson(mean, count) if is_rate else normal(mean, variance, count)
    quantiles = None if n <= MAX_DOTS else np.array([np.quantile(row, (0.05, 0.95)) for row in rows]).T
    spread = None if quantiles is None else (quantiles[0], quantiles[1])
    return Smoothed(step[at], seconds[at] / 60, mean, low, high, spread)


def normal(mean: np.ndarray, variance: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ends of the interval of a mean, from the normal distribution; NaN for a single value."""
    half = statistics.NORMAL * np.sqrt(variance / np.where(count > 1, count - 1, np.nan))
    return mean - half, mean + half


def thinned(n: int, limit: int = MAX_POINTS) -> np.ndarray:
    """Returns up to ``limit`` row numbers, evenly spaced, with the first and the last."""
    return np.unique(np.linspace(0, n - 1, min(n, limit)).round().astype(int)) if n else np.zeros(0, int)


def series(form: str, name: str, color: str, step: Any, minutes: Any, y: Any = (), **more: Any) -> Series:
    """Returns a series for JSON."""
    columns = {key: plain(value) if isinstance(value, np.ndarray) else value for key, value in more.items()}
    return {
        "kind": form,
        "name": name,
        "color": color,
        "x": np.asarray(step, np.float64).astype(np.int64).tolist(),
        "t": plain(minutes),
        "y": plain(y),
        **columns,
    }


def fit(values: np.ndarray, further: np.ndarray) -> list[float | None] | None:
    """Returns the range of an axis that shows all but the extreme half percent of values, and all further ones."""
    values, further = values[usable(values)], further[usable(further)]
    shown = np.concatenate([np.quantile(values, (0.005, 0.995)) if len(values) else [], further])
    if not len(shown):
        return None
    margin = 0.06 * (np.ptp(shown) or max(abs(shown[0]), 1.0))
    return plain(np.array([shown.min() - margin, shown.max() + margin]))


def episode_chart(episodes: Table, evaluations: Table, column: str, window: int | None = None) -> Chart | None:
    """Returns the chart of returns, successes or lengths over training; None without any number.

    Args:
        episodes: of training.
        evaluations: with the columns of :attr:`rejeu.lab.runs.read.RunSummary.evaluations`.
        column: "return", "success" or "length".
        window: episodes in the moving mean; None for :func:`window_of` their number.
    """
    values = episodes.column(column)
    is_known, is_rate = usable(values), column == "success"
    evaluated = evaluation_points(evaluations, column)
    if not is_known.any() and evaluated is None:
        return None
    n = int(is_known.sum())
    shown_series: list[Series] = []
    if n:
        curve = smooth(episodes, values, is_rate, window)
        ends = (values[is_known].min(), values[is_known].max()) if column == "length" else (-HUGE, HUGE)
        curve = curve._replace(low=np.clip(curve.low, *ends), high=np.clip(curve.high, *ends))
        at = curve.step, curve.minutes
        if curve.spread is not None and not is_rate:
            low, high = curve.spread
            shown_series.append(series("band", "5 % to 95 % of episodes", "dots", *at, low=low, high=high))
        elif not is_rate:
            where = episodes.column("step")[is_known], episodes.column("seconds")[is_known] / 60
            shown_series.append(series("dots", "episodes", "dots", *where, values[is_known]))
        shown_series.append(series("band", "95 % interval", "line", *at, low=curve.low, high=curve.high))
        shown_series.append(series("line", f"mean of {window or window_of(n):,} episodes", "line", *at, curve.mean))
    if evaluated is not None:
        shown_series.append(evaluated)
    evaluated_values = np.array(
        [] if evaluated is None else [y for end in ("y", "low", "high") for y in evaluated[end] if y is not None]
    )
    return {
        "y": {"return": "return", "success": "success rate", "length": "steps"}[column],
        "percent": is_rate,
        "range": [-0.03, 1.03] if is_rate else fit(values, evaluated_values),
        "series": shown_series,
        "note": "" if n <= MAX_DOTS else f"{n:,} episodes; each of {MAX_POINTS} points stands for {window_of(n):,}",
    }


def evaluation_points(table: Table, column: str) -> Series | None:
    """Returns the evaluations as points with error bars, where their interval is known; None if there are none."""
    name = {"return": "mean_return", "success": "success_rate", "length": "mean_length"}[column]
    mean = table.column(name)
    at = np.flatnonzero(usable(mean))
    if not len(at):
        return None
    at = at[thinned(len(at))]
    low, high = interval(table, column)
    where = table.column("step")[at], table.column("seconds")[at] / 60
    return series("points", "evaluation", "accent", *where, mean[at], low=low[at], high=high[at])


def interval(table: Table, column: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ends of the 95 % intervals of evaluations; NaN where unknown.

    Student's t for mean returns, Wilson's score for success rates.
    """
    n = table.column("episodes")
    n = np.where(n >= 1, n, np.nan)
    if column == "success":
        rate = table.column("success_rate")
        return statistics.wilson(np.where((rate >= 0) & (rate <= 1), rate, np.nan), n)
    mean = table.column("mean_return" if column == "return" else "mean_length")
    if column == "length" or not len(mean):
        return np.full(len(mean), np.nan), np.full(len(mean), np.nan)
    return statistics.student(mean, table.column("std_return"), n)


GROUPS = ("Losses", "Exploration", "Other metrics")
"""Headings of the charts of metrics."""
EXPLORATION = ("entropy", "ent_coef", "epsilon", "exploration", "noise", "std", "sigma", "temperature", "beta")
SHARES = {"env": "environment", "replay": "replay buffer", "update": "update", "rest": "rest"}
LEFT_OUT = {
    "rollout/ep_len_mean",
    "rollout/ep_rew_mean",
    "rollout/ep_rew_best",
    "rollout/success_rate",
    "train/n_updates",
}
"""Metrics that are drawn elsewhere, or say nothing."""


def group_of(name: str) -> str:
    """Returns the heading under which a metric is drawn.

    >>> group_of("train/critic_loss"), group_of("train/ent_coef"), group_of("train/q_value")
    ('Losses', 'Exploration', 'Other metrics')
    """
    last = name.rpartition("/")[2].lower()
    if "loss" in last:
        return GROUPS[0]
    return GROUPS[1] if any(word in last for word in EXPLORATION) else GROUPS[2]


def metric_charts(table: Table) -> dict[str, Chart]:
    """Returns the chart of every metric with a finite value, by name."""
    names = [name for name in table.columns if name != "step" and not name.startswith("time/") and name not in LEFT_OUT]
    names += [name for name in ("time/fps",) if name in table.columns]
    rows_of = {name: np.flatnonzero(usable(table.columns[name])) for name in names[:MAX_METRICS]}
    return {name: metric_chart(table, table.columns[name], at) for name, at in rows_of.items() if len(at)}


def metric_chart(table: Table, values: np.ndarray, at: np.ndarray) -> Chart:
    """Returns the chart of one metric at the rows ``at``; of many rows the mean, least and highest of each bin."""
    step, minutes = table.column("step"), table.column("time/time_elapsed") / 60
    note = ""
    if len(at) <= MAX_POINTS:
        form = "line" if len(at) > 1 else "points"
        shown_series = [series(form, "", "line", step[at], minutes[at], values[at])]
    else:
        rows = np.array_split(at, MAX_POINTS)
        last = np.array([row[-1] for row in rows])
        mean, low, high = (np.array([f(values[row]) for row in rows]) for f in (np.mean, np.min, np.max))
        shown_series = [
            series("band", "range", "line", step[last], minutes[last], low=low, high=high),
            series("line", "mean", "line", step[last], minutes[last], mean),
        ]
        note = f"{len(at):,} values, averaged in {MAX_POINTS} bins"
    return {
        "y": "",
        "percent": False,
        "range": fit(values[at], np.zeros(0)),
        "series": shown_series,
        "note": note,
        "small": True,
    }


def time_chart(table: Table) -> Chart | None:
    """Returns the shares of time as stacked areas; None if they are unknown."""
    shares = {name: table.column(f"time/{name}_share") for name in SHARES}
    rows = np.flatnonzero(np.isfinite(list(shares.values())).all(0))
    if not len(rows):
        return None
    at = rows[thinned(len(rows), MAX_POINTS // 2)]
    where = table.column("step")[at], table.column("time/time_elapsed")[at] / 60
    values = [np.clip(shares[name][at], 0, 1) for name in SHARES]
    shown_series = [series("area", SHARES[name], f"area{i}", *where, values[i]) for i, name in enumerate(SHARES)]
    return {"y": "", "percent": True, "range": [0, 1], "series": shown_series, "note": ""}


def histogram(values: np.ndarray, columns: Mapping[str, np.ndarray], command: str = "") -> Chart | None:
    """Returns the histogram of returns, with the episodes behind each bar; None without any return.

    The bars cover all but the extreme half percent, which the first and the last bar contain too.

    Args:
        values: returns of the episodes, ``(n,)``.
        columns: what is listed of each episode, by name, ``(n,)``.
        command: how to see the episode of seed ``N``, if the columns contain seeds.
    """
    rows_known = np.flatnonzero(usable(values))
    if not len(rows_known):
        return None
    low, high = np.quantile(values[rows_known], (0.005, 0.995)) if len(rows_known) > 400 else np.array([0, 0])
    if low == high:
        low, high = values[rows_known].min(), values[rows_known].max()
    if low == high:
        low, high = low - 0.5, high + 0.5
    n_bars = min(BARS, max(round(2 * math.sqrt(len(rows_known))), 5))
    edges = np.linspace(low, high, n_bars + 1)
    bar = np.clip(np.searchsorted(edges, values[rows_known], "right") - 1, 0, n_bars - 1)
    members = [rows_known[bar == i] for i in range(n_bars)]
    listed_rows = [rows_of_bar[thinned(len(rows_of_bar), LISTED)] for rows_of_bar in members]
    points = [np.array([column[rows_of_bar] for column in columns.values()]) for rows_of_bar in listed_rows]
    rows = [[plain(row) for row in points_of_bar.T] for points_of_bar in points]
    return {
        "edges": plain(edges),
        "counts": [len(rows_of_bar) for rows_of_bar in members],
        "columns": [*columns],
        "rows": rows,
        "least": plain([values[rows_known].min()])[0],
        "most": plain([values[rows_known].max()])[0],
        "command": command,
    }


class GoalPlace(NamedTuple):
    """Goals that are close together."""

    rows: np.ndarray
    """Of the episodes, ``int (n,)``."""
    goal: np.ndarray
    """The mean of the goals."""
    rate: float
    """The share of the episodes in which the goal was reached."""


PLACES = 16
"""Goals are one place if they are closer than about this fraction of the extent of all."""
OUTCOMES = (
    ("always reached", "good", "circle", "\N{BLACK CIRCLE}"),
    ("sometimes", "accent", "diamond", "\N{BLACK DIAMOND}"),
    ("never", "bad", "x", "\N{MULTIPLICATION SIGN}"),
)
"""Names, colors, shapes and signs of places where all, some or none of the episodes reached the goal."""


def goal_places(goals: np.ndarray, success: np.ndarray) -> list[GoalPlace]:
    """Returns the places of goals ``(n, k)``, and the shares of episodes that reached them; ``success`` is 1 or 0."""
    extent = np.ptp(goals, axis=0).max()
    cells = np.floor((goals - goals.min(0)) * (PLACES / (extent or 1.0)) + 0.5)
    numbers = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    places = [np.flatnonzero(numbers == i) for i in range(numbers.max() + 1)]
    return [GoalPlace(rows, goals[rows].mean(0), float(np.mean(success[rows] > 0.5))) for rows in places]


def goal_chart(episodes: Table) -> Chart | None:
    """Returns a map of goals by their first two numbers: which share of the episodes reached each place; None without any.

    Its ``places`` have the mean ``goal`` and the ``seeds`` of their episodes, as far as they are known.

    Args:
        episodes: with the columns ``goal_0``, ``goal_1`` and ``success``; others are ``goal_2`` and ``seed``.
    """
    names = [name for name in ("goal_0", "goal_1", "goal_2") if name in episodes.columns]
    goals, success = np.array([episodes.column(name) for name in names]).T, episodes.column("success")
    rows = np.flatnonzero(usable(goals).all(1) & np.isfinite(success)) if len(names) > 1 else np.zeros(0, int)
    if not len(rows):
        return None
    goals, places = goals[rows], goal_places(goals[rows], success[rows])
    outcomes = np.array([0 if spot.rate == 1.0 else 2 if spot.rate == 0.0 else 1 for spot in places])
    shown_series = []
    for i in np.unique(outcomes).tolist():
        at, (name, color, symbol, sign) = np.flatnonzero(outcomes == i).tolist(), OUTCOMES[i]
        x, y = np.array([places[j].goal[:2] for j in at]).T
        texts = [f"{100 * places[j].rate:.0f} % of {counted(len(places[j].rows), 'episode')}" for j in at]
        marks = {"kind": "places", "name": f"{name} ({len(at):,})", "color": color, "symbol": symbol, "sign": sign}
        shown_series.append({**marks, "places": at, "text": texts, "x": plain(x), "t": plain(x), "y": plain(y)})
    seeds, step = episodes.column("seed")[rows], episodes.column("step")[rows]
    ends = [f"step {end:,.0f}" for end in np.unique([np.min(step), np.max(step)]) if np.isfinite(end)]
    last = f", evaluated from {' to '.join(ends)}" if ends else ""
    rate = f"{100 * np.mean(success[rows] > 0.5):.0f} % of {counted(len(rows), 'episode')} reached the goal{last}"
    return {
        **{"x": "number 1 of the goal", "y": "number 2 of the goal", "percent": False, "is_equal": True},
        "range": fit(goals[:0, 1], goals[:, 1]),
        "x_range": fit(goals[:0, 0], goals[:, 0]),
        "series": shown_series,
        "note": rate,
        "places": [{"goal": spot.goal.tolist(), "seeds": plain(seeds[spot.rows])} for spot in places],
    }


def on_picture(chart: Chart, pixels: np.ndarray, picture: str, size: tuple[int, int]) -> Chart:
    """Returns a map of goals on a picture of the environment; unchanged if no goal is in it.

    Args:
        chart: of :func:`goal_chart`.
        pixels: x and y of its places in the picture, ``(n, 2)``.
        picture: its address.
        size: width and height in pixels.
    """
    if not ((pixels >= 0) & (pixels <= size)).all(1).any():
        return chart
    placed = []
    for series in chart["series"]:
        x, y = plain(pixels[series["places"], 0]), plain(pixels[series["places"], 1])
        placed.append({**series, "x": x, "t": x, "y": y})
    axes = {"x": "", "y": "", "x_range": [0, size[0]], "range": [size[1], 0]}
    return {**chart, **axes, "series": placed, "picture": picture}


def value_chart(values: np.ndarray, to_go: np.ndarray, expected: float | None = None) -> Chart:
    """Returns the chart of the critic's values along an episode and of the discounted returns; either may be empty.

    ``expected`` is what the critic expected when a time limit cut the episode, NaN without a critic; None if none did.
    """
    lines = {"discounted return from here on": ("line", to_go), "what the critic expects": ("accent", values)}
    shown_series = []
    for name, (color, line) in lines.items():
        at = thinned(len(line))
        shown_series += [series("line", name, color, at, at, line[at])] if len(at) else []
    if expected is not None:
        end, value = [max(len(values), len(to_go))], expected if math.isfinite(expected) else 0.0
        shown_series.append(series("points", "cut by the time limit", "bad", end, end, [value]))
    return {"x": "step of the episode", "y": "", "percent": False, "range": None, "series": shown_series, "note": ""}


MAX_THIN = 20
"""Most runs of a group that are drawn one by one."""
GROUP_COLORS = (
    ("#1d4f91", "#8cc0f5"),
    ("#d9631e", "#f59a56"),
    ("#1e8a5f", "#55c694"),
    ("#8a4fbe", "#c49bf0"),
    ("#c4372d", "#f2796f"),
    ("#0f8b9d", "#5fcfe0"),
    ("#a07708", "#e3bd55"),
    ("#64707d", "#97a3b0"),
)
"""Colors of the groups of a comparison on light and on dark pages; further groups repeat them."""
NAMES = {"iqm": "interquartile mean", "mean": "mean", "median": "median"}


def group_chart(form: str, comparison: Any, env_id: str | None = None) -> Chart:
    """Returns the curves, or the performance profiles, of the groups of a comparison.

    Args:
        form: "curve" or "profile".
        comparison: a :class:`rejeu.lab.reporting.comparison.Comparison`.
        env_id: only the groups of this environment; None for all.
    """
    labels = list(dict.fromkeys(group.label for group in comparison.groups))
    groups = [group for group in comparison.groups if env_id in (None, group.env_id)]
    shown_series = []
    for group in groups:
        color = f"group{labels.index(group.label) % len(GROUP_COLORS)}"
        x, (value, low, high) = (group.x, group.curve) if form == "curve" else (group.levels, group.profile)
        common = {"color": color, "x": plain(x), "t": plain(x)}
        if form == "curve" and 1 < len(group.runs) <= MAX_THIN:
            names = [run.name for run in group.runs]
            lines = zip(names, group.run_curves, strict=True)
            shown_series += [{**common, "kind": "thin", "name": name, "y": plain(line)} for name, line in lines]
        shown_series.append({**common, "kind": "band", "name": "", "low": plain(low), "high": plain(high)})
        shown_series.append({**common, "kind": "line", "name": f"{group.label} ({len(group.runs)})", "y": plain(value)})
    if form == "profile":
        low, high = plain(groups[0].levels[[0, -1]])
        axes = {"x": "final score", "y": "share of runs above it", "percent": True, "range": [0, 1.02]}
        return {**axes, "x_range": None if low == high else [low, high], "series": shown_series}
    x_title = {"steps": "environment steps", "time": "seconds of training"}[comparison.axis]
    return {"x": x_title, "y": f"return, {NAMES[comparison.statistic]}", "series": shown_series}
