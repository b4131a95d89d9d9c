"""The page of all runs below the folder: one table, in which the runs of a sweep and the seeds of a setting are folded."""

from __future__ import annotations

import math
import re
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from fastapi import Request
from nicegui import ui
from nicegui.events import ClickEventArguments, GenericEventArguments

from rejeu.core.types import JsonObject
from rejeu.lab.reporting.grouping import group_labels
from rejeu.lab.reporting.rows import POINTS, BestEvaluation, Row, cells, nothing
from rejeu.lab.studio import moving
from rejeu.lab.studio.layout import Choice, action, add_cells, address, failures_shown, follow, is_number
from rejeu.lab.studio.new import start
from rejeu.lab.studio.speech import say, translated
from rejeu.lab.studio.state import Studio
from rejeu.logs import statistics

GALLERY = {
    "CartPole-v1": ("balance", "Balance a pole"),
    "LunarLander-v3": ("rocket_launch", "Land on the moon"),
    "parking-v0": ("local_parking", "Park a car"),
    "rejeu/Ball-v0": ("sports_soccer", "Keep a ball in a box"),
}
"""Environments of the first minute, with a symbol and a title."""
COUNTS = "{} runs, {} running", "{} run, {} running"
GROUPINGS = {"folder": "by folder", "setting": "by setting", "none": "one by one"}
COLORS = {"running": "primary", "finished": "positive", "interrupted": "deep-orange-10", "crashed": "negative"}
PER_PAGE = (50, 25, 100, 200)
"""Lines of a page of the table, the usual first; the browser has no others."""
COLUMNS = {
    "run": "run", "state": "state", "steps": "steps", "best": "best return", "rate": "rate", "changed": "changed",
    "curve": "curve", "picture": "video",
}  # fmt: skip
"""Titles of the columns."""
NUMBERS, PHONE = ("steps", "best", "rate"), ("run", "state", "best")
"""Columns whose cells are to the right, and those that a phone shows."""


class Block(NamedTuple):
    """Runs that are listed together, or one alone."""

    total: Row
    """The run, or a row of the whole group."""
    members: Sequence[Row] = ()
    """The runs of a group."""


ORDERS: dict[str, Callable[[Row], str | float]] = {
    "run": lambda row: row.run,
    "state": lambda row: row.state,
    "steps": lambda row: row.steps,
    "best": lambda row: row.best.mean_return if row.best else math.nan,
    "rate": lambda row: row.steps_per_second,
    "changed": lambda row: row.changed,
}
"""Values by which lines are sorted, by column. Not a number comes last."""
USUAL = {
    "words": "", "groups": "folder", "sort": "changed", "ascending": "", "page": "1", "lines": str(PER_PAGE[0]), "opened": "",
}  # fmt: skip
"""The choice of a page whose address names none."""
VALID = {
    "groups": GROUPINGS.__contains__,
    "sort": ORDERS.__contains__,
    "page": is_number,
    "lines": [*map(str, PER_PAGE)].__contains__,
}


def build(studio: Studio, request: Request) -> None:
    """Makes the table."""
    choice = Choice(request, USUAL, VALID)
    with ui.row().classes("items-center w-full gap-2") as controls:
        words = ui.input(placeholder=say("filter"), value=choice["words"]).props(
            f"dense outlined clearable debounce=200 aria-label={say('filter')}"
        )
        grouping = ui.select(translated(GROUPINGS), value=choice["groups"]).props(
            f"dense outlined options-dense aria-label={say('groups')}"
        )
        ui.space()
        count = ui.label().classes("quiet")
        undo = ui.button(say("Undo"), icon="undo").props("flat no-caps")
        delete = ui.button(say("Delete"), icon="delete").props("outline no-caps")
        compare = ui.button(say("Compare"), icon="stacked_line_chart").props("outline no-caps")
    with ui.column().classes("w-full") as empty:
        show_gallery(studio)
    table = ui.table(rows=[], columns=columns(), row_key="key", pagination=pagination(choice, 0), selection="multiple")
    table.classes("w-full").props("flat bordered dense wrap-cells binary-state-sort column-sort-order=da")
    table.props.update({"rows-per-page-options": sorted(PER_PAGE)})
    add_cells(table, "runs.vue")
    for part, label in (("header", f"'{say('choose all')}'"), ("body", "props.row.name")):
        table.add_slot(f"{part}-selection", f'<q-checkbox v-model="props.selected" dense :aria-label="{label}" />')

    def show() -> None:
        order = choice["sort"], not choice["ascending"]
        blocks = listed(studio, studio.version, choice["words"], choice["groups"], *order)
        table.rows = [*lines(page_of(blocks, choice), {*choice["opened"].split("\n")})]
        table.pagination = pagination(choice, len(blocks))
        rows = [row for block in blocks for row in block.members or [block.total]]
        is_empty = bool(studio.version) and not (studio.rows or studio.deleted)
        for element in (empty, controls, table):
            element.set_visibility(is_empty == (element is empty))
        undo.set_visibility(bool(studio.deleted))
        running = sum(row.state == "running" for row in rows)
        unread = sum(row.state == "unread" for row in rows)
        texts = [say(COUNTS[len(rows) == 1], len(rows), running), *([say("{} not read yet", unread)] if unread else [])]
        count.text = ", ".join(texts) if studio.version else say("reading the folder")

    def choose(**changed: str) -> None:
        choice.change(**{"page": "1", **changed})
        show()

    def turn(event: GenericEventArguments) -> None:
        asked = event.args["pagination"]
        sort = asked["sortBy"] if asked["sortBy"] in ORDERS else choice["sort"]
        page, per_page = str(asked["page"]), str(asked["rowsPerPage"])
        choose(sort=sort, ascending="" if asked["descending"] else "1", page=page, lines=per_page)

    def fold(label: str) -> None:
        opened = {*filter(None, choice["opened"].split("\n"))} ^ {label}
        choose(opened="\n".join(sorted(opened)), page=choice["page"])

    def picked() -> list[str]:
        blocks = listed(studio, studio.version, choice["words"], choice["groups"], "run", False)
        return marked(blocks, {line["key"] for line in table.selected})

    def move(do: Callable[..., None], *arguments: object) -> None:
        with failures_shown():
            do(studio, *arguments)
        table.selected = []
        enable()
        show()

    def enable() -> None:
        for button in (compare, delete):
            button.set_enabled(bool(table.selected))

    enable()
    table.on_select(enable)
    delete.on_click(lambda: move(moving.delete, picked()))
    undo.on_click(lambda: move(moving.restore))
    compare.on_click(lambda: ui.navigate.to(address("/compare", run=picked())))
    table.on("request", turn, ["pagination"])
    table.on("fold", lambda event: fold(str(event.args)))
    words.on_value_change(lambda event: choose(words=event.value or ""))
    grouping.on_value_change(lambda event: choose(groups=event.value))
    follow(lambda: studio.version, show)


def marked(blocks: Iterable[Block], keys: Collection[str]) -> list[str]:
    """Returns the runs that are marked, or whose group is; those that the filter leaves out are in no block."""
    rows = [(block.total.run, row) for block in blocks for row in block.members or [block.total]]
    return [row.run for group, row in rows if row.run in keys or group in keys]


def show_gallery(studio: Studio) -> None:
    """Offers environments to those who have no run yet."""
    ui.label(say("There is no run in this folder yet. Watch an agent learn, or play yourself:")).classes("text-h6")

    async def begin(event: ClickEventArguments, env_id: str) -> None:
        event.sender.props["loading"] = True
        try:
            message.text = await start(studio, {"env": env_id}, message.set_text)
        except (ValueError, OSError) as error:
            message.text = str(error)
        event.sender.props["loading"] = False

    with ui.element("div").classes("w-full charts"):
        for env_id, (icon, title) in GALLERY.items():
            with ui.card().classes("card items-center").props("flat bordered"):
                ui.icon(icon, size="64px").classes("quiet")
                ui.label(say(title)).classes("text-weight-medium")
                ui.label(env_id).classes("quiet")
                with ui.row():
                    action(say("Watch it learn"), "school", partial(begin, env_id=env_id))
                    action(say("Play"), "sports_esports", partial(ui.navigate.to, address("/play", env=env_id)))
    message = ui.label().classes("text mono")
    ui.link(say("Another environment"), "/new").classes("run")


def columns() -> list[dict[str, str | bool]]:
    """Returns the columns, as Quasar has them."""
    return [
        {
            "name": name,
            "label": say(title),
            "field": name,
            "align": "right" if name in NUMBERS else "left",
            "sortable": name in ORDERS,
            **dict.fromkeys(("classes", "headerClasses"), "" if name in PHONE else "gt-sm"),
        }
        for name, title in COLUMNS.items()
    ]


def pagination(choice: Choice, n: int) -> dict[str, str | int | bool]:
    """Returns the page and the order of a table of ``n`` lines, as Quasar has them."""
    return {
        "sortBy": choice["sort"],
        "descending": not choice["ascending"],
        "page": int(choice["page"]),
        "rowsPerPage": int(choice["lines"]),
        "rowsNumber": n,
    }


def page_of(blocks: Sequence[Block], choice: Choice) -> Sequence[Block]:
    """Returns the blocks that are shown."""
    first = (max(int(choice["page"]), 1) - 1) * int(choice["lines"])
    return blocks[first : first + int(choice["lines"])]


@lru_cache(32)
def listed(studio: Studio, version: int, words: str, grouping: str, sort: str, descending: bool) -> list[Block]:
    """Returns the runs that contain all words in their name, environment, algorithm, state or remarks, in groups and sorted.

    Several tabs share them until the ``version`` of the rows rises.
    """
    labels = labels_of(studio, version, grouping)
    rows = [block.total for block in ordered(map(Block, chosen(studio.rows, words)), sort, descending)]
    return ordered(blocks_of(rows, [labels.get(row.run, "") for row in rows]), sort, descending)


@lru_cache(4)
def labels_of(studio: Studio, version: int, grouping: str) -> Mapping[str, str]:
    """Returns the group of each run, empty for none: the folder that it is in, or the settings in which runs differ."""
    rows, runs = studio.rows, studio.summaries
    labels = dict.fromkeys((row.run for row in rows), "")
    if grouping == "folder":
        return {run: run.rpartition("/")[0] for run in labels}
    if grouping == "setting":
        names = [row.run for row in rows if row.run in runs]
        settings = group_labels([runs[name] for name in names], "setting")[1]
        labels |= {name: f"{runs[name].config.env}: {label}" for name, label in zip(names, settings, strict=True)}
    return labels


def chosen(rows: Iterable[Row], words: str) -> list[Row]:
    """Returns the rows that contain all words in their name, environment, algorithm, state or remarks."""
    terms = words.lower().split()
    texts = ((f"{row.run} {row.env} {row.algorithm} {row.state} {remarks_of(row)}".lower(), row) for row in rows)
    return [row for text, row in texts if all(term in text for term in terms)]


def remarks_of(row: Row) -> str:
    """Returns the tags of a run, and the first line of its note."""
    return " ".join([*(f"#{tag}" for tag in row.remarks.tags), row.remarks.note.partition("\n")[0]]).strip()


def blocks_of(rows: Iterable[Row], labels: Iterable[str]) -> list[Block]:
    """Returns the rows in groups of the same label; a run alone in its group stays a run."""
    members: dict[str, list[Row]] = {}
    for row, label in zip(rows, labels, strict=True):
        members.setdefault(label or f"/{row.run}", []).append(row)
    groups = members.items()
    return [Block(together(label, runs), runs) if len(runs) > 1 else Block(runs[0]) for label, runs in groups]


def together(label: str, rows: Sequence[Row]) -> Row:
    """Returns the row of a group: sums over its runs, and means over those of one environment that are not damaged."""
    sound, running = ([row for row in rows if keeps(row.state)] for keeps in ("damaged".__ne__, "running".__eq__))
    columns = zip(*((row.env, row.algorithm) for row in rows), strict=True)
    envs, algorithms = (sorted({*filter(None, names)}) for names in columns)
    is_alike = len({row.env for row in sound}) == 1
    states = Counter(sorted((row.state for row in rows), key="running".__ne__))
    bests = np.array([row.best.mean_return for row in sound if row.best and is_alike])
    low, high = statistics.student(bests.mean(), bests.std(), len(bests)) if len(bests) else (math.nan, math.nan)
    curves = [row.curve for row in sound if len(row.curve) > 1 and is_alike]
    even = [np.interp(np.linspace(0, 1, POINTS), np.linspace(0, 1, len(curve)), curve) for curve in curves]
    return replace(
        nothing(rows[0].path, "unread"),
        run=label,
        env=", ".join(envs[:3]),
        algorithm=", ".join(algorithms[:3]),
        state=", ".join(f"{n} {state}" for state, n in states.items()),
        steps=sum(row.steps for row in rows),
        steps_asked=sum(row.steps_asked or 0 for row in rows) or None,
        seconds_left=max((row.seconds_left or 0.0 for row in running), default=None),
        steps_per_second=sum(row.steps_per_second for row in running) if running else math.nan,
        best=BestEvaluation(0, float(bests.mean()), float(low), float(high), math.nan) if len(bests) else None,
        curve=[*np.mean(even, axis=0)] if even else [],
        changed=max(row.changed for row in rows),
        notes=() if is_alike else ("several environments",),
    )


def ordered(blocks: Iterable[Block], sort: str, descending: bool) -> list[Block]:
    """Returns the blocks by the values that the table shows of them; best returns are sorted within each environment."""
    values = [(ORDERS[sort](block.total), block) for block in blocks]
    finite = sorted((pair for pair in values if pair[0] == pair[0]), key=lambda pair: pair[0], reverse=descending)
    ranked = [block for _, block in finite]
    if sort == "best":
        ranked.sort(key=lambda block: (not block.total.env, block.total.env))
    return [*ranked, *(block for value, block in values if value != value)]


def lines(blocks: Iterable[Block], opened: Collection[str]) -> Iterator[JsonObject]:
    """Yields the lines of the table: of each group of several runs one, followed by its runs if it is open."""
    for block in blocks:
        total, n = block.total, len(block.members)
        group = {"name": f"{total.run} ({n})", "is_group": True, "is_open": total.run in opened, "link": ""}
        yield line(total) | (group if n else {})
        if total.run in opened:
            yield from (line(row) | {"is_inner": True} for row in block.members)


def line(row: Row) -> JsonObject:
    """Returns the line of a run, or of a group of runs, as the slots of the table read it."""
    texts = cells(row)
    best, _, more = texts["best"].partition(" ")
    files = {name: address(f"/file/{name}", run=row.run) for name in row.pictures}
    return {
        "key": row.run,
        "name": texts["run"],
        "about": " · ".join(filter(None, (texts["environment"], texts["algorithm"]))),
        "remarks": remarks_of(row),
        "link": address("/run", run=row.run),
        "state": state_text(row.state),
        "color": COLORS.get(row.state.partition(",")[0].split()[-1], "grey-7"),
        "reason": say(row.reason),
        "steps": say(texts["steps"]),
        "share": row.share,
        "best": best,
        "more": say(re.sub("[()]", "", more)) or " ".join(map(say, row.notes) if row.state[0].isdecimal() else ()),
        "rate": say(texts["rate"]),
        "changed": time.strftime("%Y-%m-%d %H:%M", time.localtime(row.changed)) if row.changed else "",
        "curve": points(row.curve),
        "video": files.get("video.mp4"),
        "picture": files.get("curve.png"),
    }


def state_text(state: str) -> str:
    """Returns a state, or the numbers of runs in several, in the language of the page."""
    return ", ".join(" ".join(map(say, part.split())) for part in state.split(", "))


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
