"""The page about a study: history, importances, every hyperparameter, every trial, and the winner against the default."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rejeu.algorithms.search import Choice, Dimension, LogUniform, NearOne
from rejeu.experiments.search import Final
from rejeu.experiments.study import Outcome, Study, best_of
from rejeu.io import atomic
from rejeu.io.records import shown
from rejeu.reporting.charts import GROUP_COLORS, group_chart, plain
from rejeu.reporting.comparison import table_html
from rejeu.reporting.formatting import counted, number
from rejeu.reporting.report import page
from rejeu.reporting.report.sections import duration

MAX_CURVES = 100
"""Most trials whose evaluations are drawn."""
MAX_LISTED = 2000
"""Most trials that are listed."""
LOWEST = 0.1
"""Share of the trials, the lowest, for which charts need not have room."""
COLORS = {"complete": "line", "pruned": "accent", "running": "dots"}


def write(study: Study, outcomes: Sequence[Outcome], final: Final | None) -> Path:
    """Writes ``study.html`` and returns its path.

    Raises:
        MissingExtra: if plotly or jinja2 is not installed.
    """
    return atomic.write(study.folder.page, render(study, outcomes, final))


def render(study: Study, outcomes: Sequence[Outcome], final: Final | None) -> str:
    """Returns the page as text."""
    plan, best = study.plan, best_of(list(outcomes))
    space = plan.search_space
    charts: dict[str, Any] = {
        "history": history(outcomes, plan.measure),
        "curves": curves(outcomes, best, plan.measure),
    }
    slices = []
    for place, (name, dimension) in enumerate(space.items()):
        charts[f"slice{place}"] = slice_of(name, dimension, outcomes, plan.measure)
        slices.append({"id": f"slice{place}", "title": shown(name, 60), "note": ""})
    compared = None if final is None else final.comparison
    if compared is not None:
        charts["final"] = group_chart("curve", compared)
    return page.render(
        "study.html",
        {"charts": charts, "histograms": {}},
        title=f"Tuning {plan.algorithm} on {plan.env_id}",
        colors=GROUP_COLORS,
        facts=facts(study, outcomes),
        best=None
        if best is None
        else {"title": f"Trial {best.index}", "rows": settings(best), "value": number(best.value)},
        measure=plan.measure,
        slices=slices,
        importances=importances(study),
        space=[[name, str(dimension)] for name, dimension in space.items()],
        fixed=[[name, json.dumps(value)] for name, value in plan.fixed.items() if name not in space],
        names=list(space),
        trials=[row(one, space, one is best) for one in outcomes[:MAX_LISTED]],
        verdict="" if final is None else str(final),
        failed=() if final is None else final.failed,
        table="" if compared is None else table_html(compared),
        improvements=[] if compared is None else [one.cells for one in compared.improvements],
        definition="" if compared is None else compared.definition,
        journal=study.folder.journal.name,
    )


def facts(study: Study, outcomes: Sequence[Outcome]) -> list[str]:
    """Returns the line below the headline."""
    plan = study.plan
    counts = {name: sum(one.state == name for one in outcomes) for name in ("complete", "pruned", "failed", "running")}
    return [
        counted(len(outcomes), "trial"),
        *(f"{n} {name}" for name, n in counts.items() if n),
        f"{plan.steps:,} steps each",
        *([f"{plan.trial_seeds} seeds each"] if plan.trial_seeds > 1 else []),
        f"pruner {plan.pruner}",
        f"seed {plan.seed}",
    ]


def settings(outcome: Outcome) -> list[list[str]]:
    """Returns names and values of a trial's hyperparameters."""
    return [[shown(name), shown(json.dumps(value))] for name, value in outcome.values.items()]


def row(outcome: Outcome, space: dict[str, Dimension], is_best: bool) -> dict[str, Any]:
    """Returns the row of a trial in the table."""
    at = max(outcome.evaluations, default=None)
    return {
        "best": is_best,
        "index": outcome.index,
        "state": outcome.state,
        "value": number(outcome.value),
        "pruned_at": f"{at:,}" if outcome.state == "pruned" and at is not None else "",
        "time": duration(outcome.seconds) if math.isfinite(outcome.seconds) else "",
        "values": [short(outcome.values.get(name)) for name in space],
        "reason": shown(outcome.reason, 300),
    }


def short(value: Any) -> str:
    """Returns the value of a hyperparameter in a few digits."""
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else shown(json.dumps(value), 60)


def history(outcomes: Sequence[Outcome], measure: str) -> dict[str, Any]:
    """Returns the chart of the values of all trials, with the best so far."""
    series = [dots(state, [one for one in outcomes if one.state == state]) for state in ("complete", "pruned")]
    done = [one for one in outcomes if one.state == "complete"]
    if done:
        best = np.maximum.accumulate([one.value for one in done])
        series.append(line("best so far", "good", [one.index for one in done], best))
    return {
        "x": "trial",
        "plain_x": True,
        "y": measure,
        "range": room([one.value for one in outcomes]),
        "x_range": [-0.5, max(len(outcomes) - 0.5, 0.5)],
        "series": [one for one in series if one["x"]],
    }


def curves(outcomes: Sequence[Outcome], best: Outcome | None, measure: str) -> dict[str, Any]:
    """Returns the chart of the evaluations of the trials; of many trials the last ones, and the best."""
    drawn = [one for one in outcomes if one.evaluations and one is not best][-MAX_CURVES:]
    series = [
        line("", COLORS.get(one.state, "dots"), list(one.evaluations), list(one.evaluations.values())) for one in drawn
    ]
    if best is not None:
        series.append(line(f"trial {best.index}", "good", list(best.evaluations), list(best.evaluations.values())))
    values = [value for one in outcomes for value in one.evaluations.values()]
    return {"x": "environment steps", "y": measure, "range": room(values), "series": series}


def slice_of(name: str, dimension: Dimension, outcomes: Sequence[Outcome], measure: str) -> dict[str, Any]:
    """Returns the chart of the values of all trials over those of one hyperparameter.

    Values of a choice stand at 1, 2, ..., and ``labels`` are their texts. For 1 - value on a logarithmic scale the x axis
    shows that difference.
    """
    known = [one for one in outcomes if name in one.values and math.isfinite(one.value)]
    labels = [shown(json.dumps(value), 30) for value in dimension.values] if isinstance(dimension, Choice) else []
    is_log = isinstance(dimension, LogUniform | NearOne)

    def place(value: Any) -> float:
        if labels:
            return 1.0 + labels.index(shown(json.dumps(value), 30))
        return 1 - value if isinstance(dimension, NearOne) else float(value)

    series = [
        dots(state, [one for one in known if one.state == state], lambda one: place(one.values[name]))
        for state in ("complete", "pruned")
    ]
    ends = (0.5, len(labels) + 0.5) if labels else sorted(place(end) for end in dimension.ends())
    ends = [math.log10(end) for end in ends] if is_log else list(ends)
    margin = 0.03 * (ends[1] - ends[0])
    return {
        "x": f"1 - {name}" if isinstance(dimension, NearOne) else name,
        "y": measure,
        "log": is_log,
        "plain_x": True,
        "labels": labels,
        "range": room([one.value for one in known]),
        "x_range": [ends[0] - margin, ends[1] + margin],
        "series": [one for one in series if one["x"]],
    }


def dots(state: str, outcomes: Sequence[Outcome], place: Any = lambda one: one.index) -> dict[str, Any]:
    """Returns the trials of one state as dots."""
    known = [one for one in outcomes if math.isfinite(one.value)]
    x = [float(f"{place(one):.6g}") for one in known]
    return {
        "kind": "dots",
        "name": state,
        "color": COLORS[state],
        "x": x,
        "t": x,
        "y": plain([one.value for one in known]),
    }


def line(name: str, color: str, x: Sequence[float], y: Sequence[float] | np.ndarray) -> dict[str, Any]:
    """Returns a line."""
    return {"kind": "line", "name": name, "color": color, "x": list(x), "t": list(x), "y": plain(y)}


def room(values: Sequence[float]) -> list[float] | None:
    """Returns the range of an axis with room for all but the lowest tenth of the values; None without values."""
    finite = np.array([value for value in values if math.isfinite(value)])
    if not len(finite):
        return None
    low, high = float(np.quantile(finite, LOWEST)), float(finite.max())
    margin = 0.06 * ((high - low) or max(abs(high), 1.0))
    return [low - margin, high + margin]


def importances(study: Study) -> list[dict[str, Any]]:
    """Returns the importances of the hyperparameters after PED-ANOVA (Watanabe et al. 2023, arXiv:2304.10255), highest first.

    Empty with too few trials.
    """
    from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances

    done = [one for one in study.outcomes() if one.state == "complete"]
    if len({one.value for one in done}) < 2:
        return []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # experimental parts of Optuna
        try:
            found = get_param_importances(study.optuna_study, evaluator=PedAnovaImportanceEvaluator())
        except (ValueError, RuntimeError):  # all trials are alike
            return []
    values = {name.removeprefix("1 - "): float(value) for name, value in found.items() if math.isfinite(value)}
    most = max(values.values(), default=0.0)
    return [
        {"name": shown(name), "text": f"{value:.0%}", "width": round(100 * value / most, 1)}
        for name, value in values.items()
        if most > 0
    ]
