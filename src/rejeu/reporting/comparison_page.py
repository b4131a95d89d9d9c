"""A comparison as a page of HTML, and as a table for notebooks."""

from __future__ import annotations

from html import escape
from typing import Any

from rejeu.reporting.charts import GROUP_COLORS, group_chart
from rejeu.reporting.formatting import counted, number

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
        for kind in entries:
            key = f"{kind}{place}"
            charts[key] = group_chart(kind, comparison, env)
            entries[kind].append({"id": key, "title": env or "unknown environment", "note": ""})
    names = {"algorithm": "algorithms", "setting": "settings", "env": "environments"}
    n_runs = sum(len(group.runs) for group in comparison.groups)
    title = f"Comparison of {len(labels)} {names[comparison.by]}" if len(labels) > 1 else labels[0]
    return page.render(
        "compare.html",
        {"charts": charts, "histograms": {}},
        title=title,
        colors=GROUP_COLORS,
        facts=[counted(n_runs, "run"), *(envs if len(envs) <= 3 else [counted(len(envs), "environment")])],
        notes=comparison.notes,
        table=table_html(comparison),
        definition=f"{comparison.definition.capitalize()}. Intervals are 95 % stratified bootstrap intervals.",
        curves=entries["curve"],
        profiles=entries["profile"],
        improvements=[one.cells for one in comparison.improvements[:MAX_LISTED]],
        runs=run_rows(comparison)[:MAX_LISTED],
    )


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
    head, *rows = comparison.text_table()
    lines = [
        "".join(f"<{tag}{' class=text' * (i < 2)}>{escape(one)}</{tag}>" for i, one in enumerate(cells))
        for tag, cells in [("th", head), *(("td", row) for row in rows)]
    ]
    body = "".join(f"<tr>{line}</tr>" for line in lines[1:])
    return f'<div class="scroll"><table class="numbers"><thead><tr>{lines[0]}</tr></thead><tbody>{body}</tbody></table></div>'
