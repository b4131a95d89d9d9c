"""The content of a report on each run, as texts for the templates and data for the script."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core.records import shown
from rejeu.core.types import JsonObject
from rejeu.lab.reporting.report.page import ChartEntry
from rejeu.lab.reporting.report.videos import BUDGET, Video, collect
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.runs.read import RunSummary, best_row
from rejeu.logs import charts as chart_data
from rejeu.logs.charts import Chart
from rejeu.logs.formatting import counted, duration, quoted
from rejeu.logs.tables import flat

LAST = 100
"""Training episodes that stand in for a final evaluation."""
MAX_EVALUATIONS = 200
"""Most rows of the table of evaluations."""
MAX_SETTINGS = 300
CURVES, GOALS, TIME = "Learning curves", "Goals", "Time"
"""Headings."""
TITLES = {"return": "Return", "success": "Success rate", "length": "Episode length"}
"""Titles of the learning curves by the column that they show."""
MINUS = "\N{MINUS SIGN}"


class Tile(NamedTuple):
    """A figure of the headline."""

    title: str
    value: str
    note: str = ""
    more: str = ""
    step: str = ""
    """Of the training, if it is of one; the title says it too."""


class ChartGroup(NamedTuple):
    """The charts below a heading."""

    title: str
    charts: list[ChartEntry]


class Hyperparameter(NamedTuple):
    """A hyperparameter of a run, as texts."""

    name: str
    value: str
    default: str
    """That of the algorithm, where the value differs from it."""


class RunSection(NamedTuple):
    """The content of a page on one run, as the template shows it."""

    id: str
    run: RunSummary
    env: str
    algorithm: str
    tiles: list[Tile]
    facts: list[str]
    groups: list[ChartGroup]
    videos: list[Video]
    """Those that are shown."""
    histograms: set[str]
    """Those that exist: ``"episodes"`` of training, ``"replays"`` of the trained agent."""
    evaluations: list[JsonObject]
    has_success: bool
    settings: list[tuple[str, str]]
    changed: list[Hyperparameter]
    """Hyperparameters that differ from the defaults."""
    unchanged: list[Hyperparameter]
    notes: Sequence[str]
    replay_command: str
    """Command that plays episodes of the trained agent; empty without a model."""


class Parts(NamedTuple):
    """The content of a page."""

    runs: list[RunSection]
    data: JsonObject
    """For the script."""


def title_of(runs: Sequence[RunSummary]) -> str:
    """Returns the title of a page."""
    if len(runs) > 1:
        return f"{len(runs)} runs"
    return f"{runs[0].config.env or runs[0].name}, {runs[0].config.algorithm or 'unknown algorithm'}"


@np.errstate(all="ignore")  # files may hold any number
def build(runs: Sequence[RunSummary], folder: Path | None) -> Parts:
    """Returns the content of a report; ``folder`` as for :func:`rejeu.lab.reporting.report.render`."""
    sections, budget = [], BUDGET
    charts: dict[str, Chart] = {}
    histograms: dict[str, Chart] = {}
    for i, run in enumerate(runs):
        own_charts, groups = charts_of(run, f"run{i}")
        charts |= own_charts
        both = {"episodes": histogram_of(run), "replays": replays_of(run)}
        bars = {name: histogram for name, histogram in both.items() if histogram is not None}
        histograms |= {f"run{i}-{name}": histogram for name, histogram in bars.items()}
        clips, notes, spent = collect(run, folder, budget)
        budget -= spent
        sections.append(describe(run, f"run{i}", groups, clips, notes, {*bars}))
    return Parts(sections, {"charts": charts, "histograms": histograms})


def charts_of(run: RunSummary, prefix: str) -> tuple[dict[str, Chart], list[ChartGroup]]:
    """Returns the charts of a run by id, and groups of their ids and titles for the template."""
    curves: list[tuple[str, str, str, Any]] = [
        (CURVES, column, title, chart_data.episode_chart(run.episodes, run.evaluations, column))
        for column, title in TITLES.items()
    ]
    for i, (name, chart) in enumerate(chart_data.metric_charts(run.metrics).items()):
        curves.append((chart_data.group_of(name), f"metric{i}", shown(name), chart))
    curves.append((GOALS, "goals", "Goals of the trained agent", chart_data.goal_chart(run.replays)))
    curves.append((GOALS, "evaluated_goals", "Goals of the newest evaluations", chart_data.goal_chart(run.goals)))
    curves.append((TIME, "time", "Shares of the time", chart_data.time_chart(run.metrics)))
    charts: dict[str, Chart] = {}
    groups: dict[str, list[ChartEntry]] = {heading: [] for heading in (CURVES, GOALS, *chart_data.GROUPS, TIME)}
    for heading, key, title, chart in curves:
        if chart is not None:
            charts[f"{prefix}-{key}"] = chart
            groups[heading].append(ChartEntry(f"{prefix}-{key}", title, chart["note"]))
    return charts, [ChartGroup(heading, entries) for heading, entries in groups.items() if entries]


def histogram_of(run: RunSummary) -> Chart | None:
    """Returns the histogram of the training episodes."""
    columns = {name: run.episodes.column(name) for name in ("step", "env", "return", "length", "success")}
    return chart_data.histogram(columns["return"], {"episode": np.arange(1, len(run.episodes) + 1), **columns})


def replays_of(run: RunSummary) -> JsonObject | None:
    """Returns the histogram of the episodes that the trained agent played from known seeds; None without any."""
    columns = {name: run.replays.column(name) for name in ("seed", "return", "length", "success")}
    return chart_data.histogram(columns["return"], columns, replay_command(run))


def describe(
    run: RunSummary, key: str, groups: list[ChartGroup], videos: list[Video], notes: list[str], histograms: set[str]
) -> RunSection:
    """Returns the section of a run."""
    changed, unchanged = hyperparameters(run)
    return RunSection(
        id=key,
        run=run,
        env=run.config.env or "unknown environment",
        algorithm=run.config.algorithm or "unknown algorithm",
        tiles=tiles(run),
        facts=facts(run),
        groups=groups,
        videos=videos,
        histograms=histograms,
        evaluations=evaluation_rows(run),
        has_success=bool(np.isfinite(run.evaluations.column("success_rate")).any()),
        settings=settings(run),
        changed=changed,
        unchanged=unchanged,
        notes=[*run.notes, *notes],
        replay_command=f"rejeu report {path_word(run.path)} --replay 100{run.config.again()}"
        if run.format == "rejeu" and run.models
        else "",
    )


def number(value: float, digits: int = 2) -> str:
    """Returns a number for people: with separators and a typographic minus sign, a dash if it is unknown.

    >>> number(-1234.5), number(math.nan), number(1e12)
    ('−1,234.50', '–', '1e+12')
    """
    if not math.isfinite(value):
        return "\N{EN DASH}"
    text = f"{value:,.{digits}f}" if abs(value) < 1e9 else f"{value:.4g}"
    return text.replace("-", MINUS, 1)


def percent(value: float) -> str:
    """Returns a share as a percentage, a dash if it is unknown."""
    return f"{number(100 * value, 1)} %" if math.isfinite(value) else "\N{EN DASH}"


def between(low: float, high: float, as_text: Callable[[float], str] = number) -> str:
    """Returns an interval, empty if it is unknown."""
    return f"{as_text(low)} to {as_text(high)}" if math.isfinite(low) and math.isfinite(high) else ""


def tiles(run: RunSummary) -> list[Tile]:
    """Returns the figures of the headline."""
    mean, headline = run.evaluations.column("mean_return"), []
    best = best_row(run.evaluations)
    if best is not None:
        headline += evaluation_tiles(run, "Best evaluation", best)
        last = {"running": "Newest evaluation", "finished": "Final evaluation"}.get(run.state, "Last evaluation")
        headline += evaluation_tiles(run, last, int(np.flatnonzero(np.isfinite(mean))[-1]))
    else:
        headline += training_tiles(run)
    done = f"of {run.config.steps:,}" if run.config.steps else ""
    time = f"of {duration(60 * run.config.minutes)}" if run.config.minutes else ""
    return [
        *headline,
        Tile("Environment steps", f"{run.steps:,}", done),
        Tile("Training time", duration(run.seconds), time),
    ]


def evaluation_tiles(run: RunSummary, title: str, row: int) -> list[Tile]:
    """Returns the figures of one evaluation: the success rate with the return below; until there is a success the return."""
    table = run.evaluations
    mean, rate = table.column("mean_return")[row], table.column("success_rate")[row]
    step = number(table.column("step")[row], 0)
    low, high = (end[row] for end in chart_data.interval(table, "return"))
    interval = between(low, high)
    if (table.column("success_rate") > 0).any() and math.isfinite(rate):
        low, high = (end[row] for end in chart_data.interval(table, "success"))
        note = f"success, 95 % interval {between(low, high, percent)}" if math.isfinite(low) else "success"
        more = f"return {number(mean)}" + (f" ({interval})" if interval else "")
        return [Tile(title, percent(rate), note, more, step)]
    note = f"return, 95 % interval {interval}" if interval else "return"
    return [Tile(title, number(mean), note, f"success {percent(rate)}" if math.isfinite(rate) else "", step)]


def training_tiles(run: RunSummary) -> list[Tile]:
    """Returns the figures of the last training episodes of a run without evaluations."""
    returns = run.episodes.column("return")[-LAST:]
    returns = returns[np.isfinite(returns)]
    if not len(returns):
        return [Tile("Evaluation", "\N{EN DASH}", "none yet")]
    title = f"Last {counted(len(returns), 'training episode')}"
    return [Tile(title, number(float(np.mean(returns))), "return; no evaluation yet")]


def facts(run: RunSummary) -> list[str]:
    """Returns the line below the headline."""
    config = run.config
    texts = [counted(len(run.episodes), "episode")]
    texts += [f"seed {config.seed}"] if config.seed is not None else []
    texts += [f"{counted(config.n_envs, 'environment')} at once"] if config.n_envs else []
    texts += [f"{shown(config.backend)} backend"] if config.backend else []
    texts += [f"{run.steps_per_second:,.0f} steps/s"] if math.isfinite(run.steps_per_second) else []
    return texts


def evaluation_rows(run: RunSummary) -> list[JsonObject]:
    """Returns the table of evaluations; of many rows the best and others, evenly spaced."""
    table = run.evaluations
    (low, high), (rate_low, rate_high) = chart_data.interval(table, "return"), chart_data.interval(table, "success")
    best = best_row(table)
    return [
        {
            "step": number(table.column("step")[row], 0),
            "success": percent(table.column("success_rate")[row]),
            "success_interval": between(rate_low[row], rate_high[row], percent),
            "return": number(table.column("mean_return")[row]),
            "return_interval": between(low[row], high[row]),
            "deviation": number(table.column("std_return")[row]),
            "length": number(table.column("mean_length")[row], 1),
            "episodes": number(table.column("episodes")[row], 0),
            "time": duration(table.column("seconds")[row]),
            "best": row == best,
        }
        for row in chart_data.thinned(len(table), MAX_EVALUATIONS).tolist()
    ]


def value_text(value: object) -> str:
    """Returns a value of a configuration as text; a schedule in words.

    >>> value_text({"schedule": "linear", "start": 0.2, "end": 0.0, "fraction": 1.0}), value_text(None)
    ('linear: start 0.2, end 0.0, fraction 1.0', 'None')
    """
    if isinstance(value, dict) and isinstance(label := value.get("schedule", value.get("noise")), str):
        parameters = {name: entry for name, entry in value.items() if name not in ("schedule", "noise")}
        return shown(f"{label}: {', '.join(f'{name} {value_text(parameters[name])}' for name in parameters)}", 200)
    if value is None or isinstance(value, bool):
        return str(value)
    return shown(value if isinstance(value, str) else json.dumps(value), 200)


def hyperparameters(run: RunSummary) -> tuple[list[Hyperparameter], list[Hyperparameter]]:
    """Returns the hyperparameters that differ from the defaults, and the others."""
    changed, unchanged = [], []  # type: list[Hyperparameter], list[Hyperparameter]
    for name, value in list(flat(run.config.hyperparameters))[:MAX_SETTINGS]:
        default = value_text(run.changed[name][1]) if name in run.changed else ""
        (changed if name in run.changed else unchanged).append(Hyperparameter(shown(name), value_text(value), default))
    return changed, unchanged


def settings(run: RunSummary) -> list[tuple[str, str]]:
    """Returns the configuration of the run without the hyperparameters, where it differs from what is usual."""
    if run.format != "rejeu":
        return []
    usual = asdict(RunConfig(env=""))
    hidden = ("hyperparameters", "env", "algorithm")
    rows = [(name, value) for name, value in asdict(run.config).items() if name not in hidden and value != usual[name]]
    return [(name, value_text(value)) for name, value in rows]


def replay_command(run: RunSummary) -> str:
    """Returns the command that shows episodes of the trained agent; empty if there is no model."""
    if run.format != "rejeu" or not run.models:
        return ""
    option = "" if RunFolder(run.path).best in run.models else " --which last"
    return f"rejeu watch {path_word(run.path)}{option} --seed N --episodes 1{run.config.again()}"


def path_word(path: Path) -> str:
    """Returns a path as a word of a command line, relative to the current folder if it is inside."""
    here = Path.cwd()
    return quoted(shown(path.relative_to(here) if path.is_relative_to(here) else path, 500))
