"""The page of all runs below the folder: one table, in which the runs of a sweep and the seeds of a setting are folded."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from fastapi import Request
from nicegui import ui

from rejeu.core.types import JsonObject
from rejeu.lab.reporting.grouping import group_labels
from rejeu.lab.reporting.rows import POINTS, Row, best_text, cells
from rejeu.lab.runs.read import RunSummary
from rejeu.lab.studio.layout import address, follow
from rejeu.lab.studio.state import Studio
from rejeu.logs import statistics
from rejeu.logs.formatting import counted

GROUPINGS = {"folder": "by folder", "setting": "by setting", "none": "one by one"}
ORDERS: dict[str, Callable[[Row], Any]] = {
    "newest first": lambda row: -row["changed"],
    "by name": lambda row: row["run"],
    "best first": lambda row: -row["best"]["mean_return"] if row["best"] else math.inf,
    "fastest first": lambda row: -row["steps_per_second"] if row["state"] == "running" else 0.0,
}
COLORS = {"running": "primary", "finished": "positive", "interrupted": "orange-9", "crashed": "negative"}
WIDE = "gt-sm"
"""Class of the columns that a phone leaves out."""
COLUMNS = [
    {"name": "run", "label": "run", "field": "name", "align": "left"},
    {"name": "state", "label": "state", "field": "state", "align": "left"},
    {"name": "steps", "label": "steps", "field": "steps", "align": "right", "classes": WIDE, "headerClasses": WIDE},
    {"name": "best", "label": "best return", "field": "best", "align": "right"},
    {"name": "rate", "label": "rate", "field": "rate", "align": "right", "classes": WIDE, "headerClasses": WIDE},
    {"name": "curve", "label": "curve", "field": "curve", "align": "left", "classes": WIDE, "headerClasses": WIDE},
    {"name": "picture", "label": "", "field": "picture", "align": "left", "classes": WIDE, "headerClasses": WIDE},
]
SLOTS = {
    "run": """<q-td :props="props" :style="{paddingLeft: props.row.inner ? '28px' : '8px'}">
        <q-btn v-if="props.row.group" flat dense no-caps align="left" :icon="props.row.open ? 'expand_more' : 'chevron_right'"
          :label="props.row.name" @click="$parent.$emit('fold', props.row.key)" />
        <a v-else class="run" :href="props.row.link">{{ props.row.name }}</a>
        <div class="text-caption quiet">{{ props.row.about }}</div></q-td>""",
    "state": """<q-td :props="props"><q-badge :color="props.row.color" :label="props.row.state" />
        <div class="text-caption quiet notes">{{ props.row.note }}</div></q-td>""",
    "steps": """<q-td :props="props">{{ props.row.steps }}
        <q-linear-progress v-if="props.row.share != null" :value="props.row.share" /></q-td>""",
    "best": """<q-td :props="props">{{ props.row.best }}<div class="text-caption quiet">{{ props.row.more }}</div></q-td>""",
    "curve": """<q-td :props="props"><svg width="110" height="28" role="img" aria-label="curve"><polyline
        :points="props.row.curve" fill="none" stroke="var(--line)" stroke-width="1.5" /></svg></q-td>""",
    "picture": """<q-td :props="props"><video v-if="props.row.video" :src="props.row.video" muted loop preload="metadata"
        class="picture" onmouseenter="this.play()" onmouseleave="this.pause()"></video>
        <img v-else-if="props.row.picture" :src="props.row.picture" class="picture" loading="lazy" alt=""></q-td>""",
}
"""Cells as Vue's templates, which escape what they are given."""


def build(studio: Studio, request: Request) -> None:
    """Makes the table."""
    opened: set[str] = set()
    with ui.row().classes("items-center w-full gap-2"):
        words = ui.input(placeholder="filter").props("dense outlined clearable debounce=200 aria-label=filter")
        grouping = ui.select(GROUPINGS, value="folder").props("dense outlined options-dense aria-label=groups")
        order = ui.select([*ORDERS], value="newest first").props("dense outlined options-dense aria-label=order")
        ui.space()
        count = ui.label().classes("quiet")
        compare = ui.button("Compare", icon="stacked_line_chart").props("outline no-caps")
    with ui.row().classes("items-center") as empty:
        ui.label("There are no runs below this folder yet.")
        ui.link("New run", "/new").classes("run")
    table = ui.table(rows=[], columns=COLUMNS, row_key="key", pagination={"rowsPerPage": 50}, selection="multiple")
    table.classes("w-full").props("flat bordered dense wrap-cells")
    compare.bind_enabled_from(table, "selected", bool)
    for name, template in SLOTS.items():
        table.add_slot(f"body-cell-{name}", template)

    def show() -> None:
        rows = sorted(chosen(studio.rows, words.value or ""), key=ORDERS[order.value])
        labels = labels_of(rows, studio.summaries, grouping.value)
        table.rows = [*lines(rows, labels, opened)]
        empty.set_visibility(bool(studio.version) and not studio.rows)
        running = sum(row["state"] == "running" for row in rows)
        count.text = f"{counted(len(rows), 'run')}, {running} running" if studio.version else "reading the folder"

    def picked() -> list[str]:
        rows, keys = chosen(studio.rows, words.value or ""), {line["key"] for line in table.selected}
        labels = labels_of(rows, studio.summaries, grouping.value)
        return [row["run"] for row, label in zip(rows, labels, strict=True) if keys & {row["run"], label}]

    def fold(key: str) -> None:
        opened.symmetric_difference_update({key})
        show()

    compare.on_click(lambda: ui.navigate.to(address("/compare", run=picked())))
    table.on("fold", lambda event: fold(str(event.args)))
    for control in (words, grouping, order):
        control.on_value_change(show)
    follow(studio, show)


def chosen(rows: Iterable[Row], words: str) -> list[Row]:
    """Returns the rows that contain all words in their name, environment, algorithm or state."""
    terms = words.lower().split()
    texts = ((" ".join(str(row[name]) for name in ("run", "env", "algorithm", "state")).lower(), row) for row in rows)
    return [row for text, row in texts if all(term in text for term in terms)]


def labels_of(rows: Sequence[Row], runs: Mapping[str, RunSummary], grouping: str) -> list[str]:
    """Returns the group of each row, empty for none: the folder that it is in, or the settings in which runs differ."""
    if grouping == "folder":
        return [row["run"].rpartition("/")[0] for row in rows]
    if grouping == "none":
        return [""] * len(rows)
    names = [row["run"] for row in rows if row["run"] in runs]
    labels = dict(zip(names, group_labels([runs[name] for name in names], "setting")[1], strict=True))
    return [f"{row['env']}: {labels[row['run']]}" if row["run"] in labels else "" for row in rows]


def lines(rows: Sequence[Row], labels: Sequence[str], opened: set[str]) -> Iterable[JsonObject]:
    """Yields the lines of the table: of each group of several runs one, followed by its runs if it is open."""
    members: dict[str, list[Row]] = {}
    for row, label in zip(rows, labels, strict=True):
        members.setdefault(label or f"/{row['run']}", []).append(row)
    for label, group in members.items():
        if len(group) == 1:
            yield line(group[0])
            continue
        yield group_line(label, group, label in opened)
        if label in opened:
            yield from ({**line(row), "inner": True} for row in group)


def line(row: Row) -> JsonObject:
    """Returns the line of a run."""
    texts = cells(row)
    files = {name: address(f"/file/{name}", run=row["run"]) for name in row["pictures"]}
    return {
        "key": row["run"],
        "name": texts["run"],
        "about": " · ".join(filter(None, (texts["environment"], texts["algorithm"]))),
        "link": address("/run", run=row["run"]),
        "state": row["state"],
        "color": COLORS.get(row["state"], "grey-7"),
        "note": next(iter(row["notes"]), "") if row["state"] in ("damaged", "gone", "crashed") else "",
        "steps": texts["steps"],
        "share": share([row]),
        **best_lines(row),
        "rate": texts["rate"],
        "curve": points(row["curve"]),
        "video": files.get("video.mp4"),
        "picture": files.get("curve.png"),
    }


def group_line(label: str, rows: Sequence[Row], is_open: bool) -> JsonObject:
    """Returns the line of several runs: the mean of their best returns with its 95 % interval over the runs."""
    states = Counter(row["state"] for row in rows)
    bests = np.array([row["best"]["mean_return"] for row in rows if row["best"]])
    best = None
    if len(bests):
        low, high = statistics.student(bests.mean(), bests.std(), len(bests))
        best = {"mean_return": bests.mean(), "low": float(low), "high": float(high), "success_rate": math.nan}
    rates = [row["steps_per_second"] for row in rows if row["state"] == "running"]
    curves = [row["curve"] for row in rows if len(row["curve"]) > 1]
    even = [np.interp(np.linspace(0, 1, POINTS), np.linspace(0, 1, len(curve)), curve) for curve in curves]
    facts = (", ".join(sorted({row[name] for row in rows} - {""})[:3]) for name in ("env", "algorithm"))
    return {
        "key": label,
        "group": True,
        "open": is_open,
        "name": f"{label} ({len(rows)})",
        "about": " · ".join(filter(None, facts)),
        "state": ", ".join(f"{n} {state}" for state, n in states.items()),
        "color": COLORS.get(max(states, key=lambda state: (state == "running", states[state])), "grey-7"),
        "steps": f"{sum(row['steps'] for row in rows):,}",
        "share": share(rows),
        **best_lines({"best": best, "mean_return": math.nan}),
        "rate": f"{sum(rates):,.0f}/s" if rates else "",
        "curve": points([*np.mean(even, axis=0)]) if even else "",
    }


def best_lines(row: Row) -> dict[str, str]:
    """Returns the best return, and its interval as the line below it."""
    value, _, more = best_text(row).partition(" ")
    return {"best": value, "more": more.replace("(", "").replace(")", "")}


def share(rows: Sequence[Row]) -> float | None:
    """Returns the share of the steps that are done; None if nothing runs."""
    asked = sum(row["steps_asked"] or 0 for row in rows)
    is_running = any(row["state"] == "running" for row in rows)
    return min(sum(row["steps"] for row in rows) / asked, 1.0) if asked and is_running else None


def points(values: Sequence[float]) -> str:
    """Returns a small curve as the points of a polyline in a box of 110 x 28.

    >>> points([0.0, 1.0])
    '1,26 109,2'
    """
    if len(values) < 2:
        return ""
    low, high = min(values), max(values)
    x = np.linspace(1, 109, len(values))
    y = 26 - 24 * (np.array(values) - low) / ((high - low) or 1.0)
    return " ".join(f"{a:.4g},{b:.4g}" for a, b in zip(x, y, strict=True))
