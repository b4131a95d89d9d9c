"""The page that compares groups of runs: final scores with intervals, curves and performance profiles."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Sequence
from dataclasses import replace

from fastapi import Request
from nicegui import ui

from rejeu.core.errors import expected_errors, one_line
from rejeu.core.records import shown
from rejeu.core.types import JsonObject
from rejeu.lab.reporting.comparison import MAX_LISTED, Comparison, Improvement, compare
from rejeu.lab.reporting.rows import Row
from rejeu.lab.studio.figures import Figure, add_scripts
from rejeu.lab.studio.layout import Choice
from rejeu.lab.studio.speech import say, translated
from rejeu.lab.studio.state import Studio
from rejeu.logs.charts import GROUP_COLORS, group_chart

EVERY = 3.0
"""Seconds between two looks whether a run that is compared has changed."""
CHOICES: dict[str, dict[str, str]] = {
    "by": {"": "groups: automatic", "algorithm": "by algorithm", "setting": "by setting", "env": "by environment"},
    "x": {"steps": "over steps", "time": "over time"},
    "score": {"training": "end of training", "evaluation": "last evaluation"},
    "statistic": {"iqm": "interquartile mean", "mean": "mean", "median": "median"},
    "normalize": {"": "returns", "range": "scaled to the range"},
}
"""Arguments of a comparison that people choose, the default first; an empty one is None."""
MOST_DRAWN, ROWS = 8, 50
"""Environments drawn at once, and rows of a table: browsers are slow with hundreds."""
INTERVALS = "Intervals are 95 % stratified bootstrap intervals."
PAIRS = "{}: probability that a run of the group in the row has a higher final score than one of the column"
BETTER = ("group", "better than", "environment", "probability (95 % interval)")
MAX_MATRIX = 12
"""Most groups whose pairs are a matrix; those of more are a list."""
SAVED = {"html": "page", "csv": "table", "curves.csv": "curves"}
"""Files to save by their ending."""
MATRIX = """<q-td :props="props" :style="{background: props.row[props.col.name].color}"
    :title="props.row[props.col.name].more">{{ props.row[props.col.name].text }}</q-td>"""
SCORES = """<q-td :props="props">{{ props.row[0] }} <q-badge v-if="props.row.standing" outline color="primary"
    :label="props.row.standing" /></q-td>"""
"""Cells as Vue's templates, which escape what they are given."""


def build(studio: Studio, request: Request) -> None:
    """Makes the page of the runs that its address names as ``run``; of all that could be read, if it names none."""
    add_scripts()
    for theme, colors in zip((":root", ".body--dark"), zip(*GROUP_COLORS, strict=True), strict=True):
        ui.add_css(f"{theme} {{ {''.join(f'--group{i}: {color};' for i, color in enumerate(colors))} }}")
    runs, choice = request.query_params.getlist("run"), choice_of(request)
    with ui.row().classes("items-center w-full gap-2"):
        controls = {name: ui.select(translated(names), value=choice[name]) for name, names in CHOICES.items()}
        ui.space()
        ui.label(say("save:")).classes("quiet")
        links = {ending: ui.link(say(title), "/").classes("run") for ending, title in SAVED.items()}
    status = ui.label().classes("text")
    results = ui.column().classes("w-full gap-4")
    previous: object = None

    async def look() -> None:
        nonlocal previous
        rows = selected(studio, runs)[0]
        state = [(row.run, row.changed) for row in rows], {**choice.values}
        if state == previous or not (studio.version or runs):
            return
        previous = state
        for ending, link in links.items():
            link.props["href"] = choice.address(f"/save/comparison/{ending}")
        status.text = say("comparing {} runs ...", len(rows))
        try:
            comparison = await asyncio.to_thread(compared, studio, runs, choice)
        except expected_errors() as error:
            results.clear()
            status.text = one_line(error) if rows or runs else say("There is no run in this folder yet.")
        else:
            status.text = "\n".join(comparison.notes)
            results.clear()
            with results:
                show(comparison)

    async def change(name: str, value: str) -> None:
        choice.change(**{name: value})
        await look()

    for name, control in controls.items():
        control.props(f"dense outlined options-dense aria-label={say(name)}")
        control.on_value_change(lambda event, name=name: change(name, event.value))
    ui.timer(EVERY, look)


def choice_of(request: Request) -> Choice:
    """Returns the arguments of a comparison that an address names."""
    usual = {name: next(iter(names)) for name, names in CHOICES.items()}
    return Choice(request, usual, {name: names.__contains__ for name, names in CHOICES.items()}, ["run"])


def compared(studio: Studio, runs: Sequence[str], choice: Choice) -> Comparison:
    """Returns the comparison of runs, with a note about names that lead to none.

    Raises:
        ValueError: if there is nothing to compare.
        FileNotFoundError: if a run has just disappeared.
    """
    rows, missing = selected(studio, runs)
    names = f"not compared, since renamed, moved or deleted: {shown(', '.join(missing), 200)}"
    notes = (names,) if missing else ()
    if missing and not rows:
        raise ValueError(f"there is nothing to compare; {names}")
    arguments: JsonObject = {name: text or None for name, text in choice.values.items()}
    comparison = compare([row.path for row in rows], **arguments)
    return replace(comparison, notes=notes + comparison.notes)


def selected(studio: Studio, runs: Sequence[str]) -> tuple[list[Row], list[str]]:
    """Returns the rows of runs and of folders of runs, without a name all readable ones; and the names that lead to none."""
    present = [row for row in studio.rows if row.state != "gone"]
    if not runs:
        return [row for row in present if row.state != "damaged"], []
    members = {name: [row for row in present if row.run == name or row.run.startswith(f"{name}/")] for name in runs}
    names = {row.run for rows in members.values() for row in rows}
    return [row for row in present if row.run in names], [run for run, rows in members.items() if not rows]


def show(comparison: Comparison) -> None:
    """Shows tables and charts; they are those of the page of ``rejeu compare``."""
    head, *rows = comparison.text_table()
    scores = table(head, rows)
    for cells, standing in zip(scores.rows, comparison.standings, strict=True):
        cells["standing"] = say(standing)
    scores.add_slot("body-cell-0", SCORES)
    ui.label(f"{say(comparison.definition).capitalize()}. {say(INTERVALS)}").classes("quiet")
    envs = {group.env_id: group.env_id or say("unknown environment") for group in comparison.groups}

    def draw(env_ids: Sequence[str]) -> None:
        charts.clear()
        with charts:
            for env_id in env_ids[:MOST_DRAWN]:
                for form, name in (("curve", "returns"), ("profile", "performance profile")):
                    title = f"{envs[env_id]}: {say(name)}"
                    with ui.column().classes("gap-0"):
                        ui.label(title)
                        Figure(title, group_chart(form, comparison, env_id), "300px")

    if len(envs) > MOST_DRAWN:
        label = say("environments drawn, {} of {} at most", MOST_DRAWN, len(envs))
        first = [*envs][:MOST_DRAWN]
        control = ui.select(envs, label=label, value=first, multiple=True, with_input=True)
        control.on_value_change(lambda event: draw(event.value))
    charts = ui.element("div").classes("w-full charts")
    draw([*envs])
    if comparison.settings:
        head, *rows = comparison.settings
        ui.label(say("Settings that differ"))
        table(head, rows)
    for env in envs:
        pairs = [improvement for improvement in comparison.improvements if improvement.env_id == env]
        labels = [group.label for group in comparison.groups if group.env_id == env]
        if pairs and len(labels) <= MAX_MATRIX:
            ui.label(say(PAIRS, env))
            show_matrix(labels, matrix(labels, pairs))
        elif pairs:
            ui.label(say("Probability that a run of the group has a higher final score than a run of the other"))
            table(BETTER, [improvement.cells for improvement in pairs[:MAX_LISTED]])


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> ui.table:
    """Shows a table of texts."""
    columns = [{"name": str(i), "label": say(text), "field": str(i), "align": "left"} for i, text in enumerate(head)]
    cells: list[JsonObject] = [{str(i): text for i, text in enumerate(row)} for row in rows]
    shown = ui.table(rows=cells, columns=columns, pagination=ROWS if len(cells) > ROWS else None)
    return shown.classes("w-full").props("flat bordered dense")


def matrix(labels: Sequence[str], pairs: Iterable[Improvement]) -> list[list[dict[str, str]]]:
    """Returns for each group in the order of the labels its cells against each of them: ``text``, ``color`` and ``more``."""
    cells: dict[tuple[str, str], dict[str, str]] = {}
    for pair in pairs:
        for first, second, share in (
            (pair.label, pair.other, pair.probability),
            (pair.other, pair.label, 1 - pair.probability),
        ):
            color = (
                f"color-mix(in srgb, var(--{'good' if share >= 0.5 else 'bad'}) {abs(share - 0.5):.0%}, transparent)"
            )
            better, worse, _, text = pair.cells
            cells[first, second] = {"text": f"{share:.0%}", "color": color, "more": f"{better} > {worse}: {text}"}
    return [[cells.get((first, second), {}) for second in labels] for first in labels]


def show_matrix(labels: Sequence[str], rows: Sequence[Sequence[dict[str, str]]]) -> None:
    """Shows the pairs of groups."""
    shown = table(["group", *labels], [[label] for label in labels])
    for cells, row in zip(shown.rows, rows, strict=True):
        cells |= {str(i + 1): cell for i, cell in enumerate(row)}
    for i in range(len(labels)):
        shown.add_slot(f"body-cell-{i + 1}", MATRIX)
