"""The page that compares groups of runs: final scores with intervals, curves and performance profiles."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path

from fastapi import Request
from nicegui import ui

from rejeu.core.errors import expected_errors, one_line
from rejeu.lab.reporting.comparison import MAX_LISTED, Comparison, compare
from rejeu.lab.studio.figures import Figure
from rejeu.lab.studio.state import Studio
from rejeu.logs.charts import GROUP_COLORS, group_chart

EVERY = 3.0
"""Seconds between two looks whether a run that is compared has changed."""
CHOICES: dict[str, dict[str | None, str]] = {
    "by": {None: "groups: automatic", "algorithm": "by algorithm", "setting": "by setting", "env": "by environment"},
    "x": {"steps": "over steps", "time": "over time"},
    "score": {"training": "end of training", "evaluation": "last evaluation"},
    "statistic": {"iqm": "interquartile mean", "mean": "mean", "median": "median"},
    "normalize": {None: "returns", "range": "scaled to the range"},
}
"""Arguments of a comparison that people choose, the default first."""
MOST_DRAWN, ROWS = 8, 50
"""Environments drawn at once, and rows of a table: browsers are slow with hundreds."""
BETTER = ("group", "better than", "environment", "probability (95 % interval)")


def build(studio: Studio, request: Request) -> None:
    """Makes the page of the runs that its address names as ``run``; of all that could be read, if it names none."""
    for theme, colors in zip((":root", ".body--dark"), zip(*GROUP_COLORS, strict=True), strict=True):
        ui.add_css(f"{theme} {{ {''.join(f'--group{i}: {color};' for i, color in enumerate(colors))} }}")
    runs = request.query_params.getlist("run")
    with ui.row().classes("items-center w-full gap-2"):
        controls = {name: ui.select(names, value=next(iter(names))) for name, names in CHOICES.items()}
    status = ui.label().classes("text")
    results = ui.column().classes("w-full gap-4")
    previous: object = None

    async def look() -> None:
        nonlocal previous
        rows = [
            row for row in studio.rows if row["run"] in runs or (not runs and row["state"] not in ("damaged", "gone"))
        ]
        settings = {name: control.value for name, control in controls.items()}
        state = [(row["run"], row["changed"]) for row in rows], settings
        if state == previous or not (studio.version or runs):
            return
        previous = state
        status.text = f"comparing {len(rows)} runs ..."
        try:
            comparison = await asyncio.to_thread(compare, [Path(row["path"]) for row in rows], **settings)
        except expected_errors() as error:
            results.clear()
            status.text = one_line(error)
        else:
            status.text = "\n".join(comparison.notes)
            results.clear()
            with results:
                show(comparison)

    for name, control in controls.items():
        control.props(f"dense outlined options-dense aria-label={name}")
        control.on_value_change(look)
    ui.timer(EVERY, look)


def show(comparison: Comparison) -> None:
    """Shows tables and charts; they are those of the page of ``rejeu compare``."""
    head, *rows = comparison.text_table()
    table(head, rows)
    ui.label(f"{comparison.definition.capitalize()}. Intervals are 95 % stratified bootstrap intervals.").classes(
        "quiet"
    )
    names = {group.env_id: group.env_id or "unknown environment" for group in comparison.groups}

    def draw(env_ids: Sequence[str]) -> None:
        charts.clear()
        with charts:
            for env_id in env_ids[:MOST_DRAWN]:
                for form, title in (("curve", "returns"), ("profile", "performance profile")):
                    with ui.column().classes("gap-0"):
                        ui.label(f"{names[env_id]}: {title}")
                        Figure(group_chart(form, comparison, env_id), "300px")

    if len(names) > MOST_DRAWN:
        label = f"environments drawn, {MOST_DRAWN} of {len(names)} at most"
        first = [*names][:MOST_DRAWN]
        ui.select(
            names, label=label, value=first, multiple=True, with_input=True, on_change=lambda event: draw(event.value)
        )
    charts = ui.element("div").classes("w-full charts")
    draw([*names])
    if comparison.improvements:
        ui.label("Probability that a run of the group has a higher final score than a run of the other")
        table(BETTER, [improvement.cells for improvement in comparison.improvements[:MAX_LISTED]])


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Shows a table of texts."""
    columns = [{"name": str(i), "label": text, "field": str(i), "align": "left"} for i, text in enumerate(head)]
    cells = [{str(i): text for i, text in enumerate(row)} for row in rows]
    ui.table(rows=cells, columns=columns, pagination=ROWS if len(rows) > ROWS else None).classes("w-full").props(
        "flat bordered dense"
    )
