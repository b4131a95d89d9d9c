"""A comparison as a page of HTML, and as a table for notebooks."""

from __future__ import annotations

from html import escape
from typing import Any

from rejeu.reporting.plots.comparison import NAMES
from rejeu.reporting.report.curves import plain
from rejeu.reporting.tabular import improvement_row, number, reached_text
from rejeu.reporting.text import counted

COLORS = (
    ("#1d4f91", "#8cc0f5"),
    ("#d9631e", "#f59a56"),
    ("#1e8a5f", "#55c694"),
    ("#8a4fbe", "#c49bf0"),
    ("#c4372d", "#f2796f"),
    ("#0f8b9d", "#5fcfe0"),
    ("#a07708", "#e3bd55"),
    ("#64707d", "#97a3b0"),
)
"""Colors of the groups on light and on dark pages; further groups repeat them."""
MAX_LISTED = 500
"""Most runs and probabilities that are listed."""


def render(comparison: Any) -> str:
    """Returns the page.

    Raises:
        MissingExtra: if plotly or jinja2 is not installed.
    """
    from rejeu.reporting.report import page

    envs = list(dict.fromkeys(group.env_id for group in comparison.groups))
    labels = list(dict.fromkeys(group.label for group in comparison.groups))
    charts: dict[str, Any] = {}
    entries: dict[str, list[dict[str, str]]] = {"curve": [], "profile": []}
    for place, env in enumerate(envs):
        groups = [group for group in comparison.groups if group.env_id == env]
        for kind in entries:
            key = f"{kind}{place}"
            charts[key] = chart(kind, groups, labels, comparison)
            entries[kind].append({"id": key, "title": env or "unknown environment", "note": ""})
    names = {"algorithm": "algorithms", "setting": "settings", "env": "environments"}
    n_runs = sum(len(group.runs) for group in comparison.groups)
    title = f"Comparison of {len(labels)} {names[comparison.by]}" if len(labels) > 1 else labels[0]
    return page.render(
        "compare.html",
        {"charts": charts, "histograms": {}},
        title=title,
        colors=COLORS,
        facts=[counted(n_runs, "run"), *(envs if len(envs) <= 3 else [counted(len(envs), "environment")])],
        notes=comparison.notes,
        table=table_html(comparison),
        definition=f"{comparison.definition.capitalize()}. Intervals are 95 % stratified bootstrap intervals.",
        curves=entries["curve"],
        profiles=entries["profile"],
        improvements=[improvement_row(one) for one in comparison.improvements[:MAX_LISTED]],
        runs=run_rows(comparison)[:MAX_LISTED],
    )


def chart(kind: str, groups: list[Any], labels: list[str], comparison: Any) -> dict[str, Any]:
    """Returns the curves, or the performance profiles, of the groups of one environment."""
    series = []
    for group in groups:
        color = f"group{labels.index(group.label) % len(COLORS)}"
        x, (value, low, high) = (group.x, group.curve) if kind == "curve" else (group.levels, group.profile)
        common = {"color": color, "x": plain(x), "t": plain(x)}
        series.append({**common, "kind": "band", "name": "", "low": plain(low), "high": plain(high)})
        series.append({**common, "kind": "line", "name": f"{group.label} ({len(group.runs)})", "y": plain(value)})
    if kind == "profile":
        low, high = plain(groups[0].levels[[0, -1]])
        own = {"x": "final score", "y": "share of runs above it", "percent": True, "range": [0, 1.02]}
        return {**own, "x_range": None if low == high else [low, high], "series": series}
    x_title = {"steps": "environment steps", "time": "seconds of training"}[comparison.axis]
    return {"x": x_title, "y": f"return, {NAMES[comparison.statistic]}", "series": series}


def run_rows(comparison: Any) -> list[list[str]]:
    """Returns one row for each run."""
    rows = []
    for group in comparison.groups:
        for run, score in zip(group.runs, group.run_scores, strict=True):
            seed = "" if run.seed is None else str(run.seed)
            rows.append([run.name, group.label, run.env_id, seed, run.state, f"{run.steps:,}", number(score)])
    return rows


def table_html(comparison: Any) -> str:
    """Returns the table of the groups as HTML, everything escaped; needs no other package."""
    head = ["group", "environment", "runs", "IQM", "95 % interval", "mean", "median", f"{comparison.axis} to threshold"]
    lines = ["".join(f"<th{' class=text' * (i < 2)}>{escape(name)}</th>" for i, name in enumerate(head))]
    for group in comparison.groups:
        value, low, high = map(number, group.score)
        cells = [group.label, group.env_id, str(len(group.runs)), value, f"{low} to {high}"]
        cells += [number(group.mean), number(group.median), reached_text(group)]
        lines.append("".join(f"<td{' class=text' * (i < 2)}>{escape(one)}</td>" for i, one in enumerate(cells)))
    body = "".join(f"<tr>{line}</tr>" for line in lines[1:])
    return f'<div class="scroll"><table class="numbers"><thead><tr>{lines[0]}</tr></thead><tbody>{body}</tbody></table></div>'
