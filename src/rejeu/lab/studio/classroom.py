"""The page of a class: a leaderboard of the models below the folder, in English or French, also for a projector."""

from __future__ import annotations

from functools import cache

from fastapi import Request
from nicegui import ui

from rejeu.core.language import Language, said
from rejeu.core.types import JsonObject
from rejeu.lab.reporting.rows import Row
from rejeu.lab.studio.judging import Judging
from rejeu.lab.studio.layout import HERE, add_cells, address, follow
from rejeu.lab.studio.speech import language_here, say
from rejeu.lab.studio.state import Studio
from rejeu.teaching.courses import leaderboard
from rejeu.teaching.courses.leaderboard import Leaderboard

PLACES = "Models whose intervals overlap may be equally good: the place is the range that the intervals allow."
NAMES = ("place", "name", "algorithm", "steps", "seed", "return", "interval", "success", "length")
LEFT_OUT = dict.fromkeys(("algorithm", "steps", "seed", "length"), "gt-sm small")
LEFT_OUT |= dict.fromkeys(("bar", "success"), "gt-xs")
"""Classes of columns that a phone, or the projector, leaves out."""


@cache
def judging_of(studio: Studio) -> Judging:
    """Returns the results of a studio's folder, the same for all pages."""
    return Judging(studio)


def build(studio: Studio, request: Request) -> None:
    """Makes the page; its address may name a ``language``, and ``projector`` for large letters."""
    ui.add_css(HERE / "classroom.css")
    judging, language = judging_of(studio), language_here()
    is_large = "projector" in request.query_params
    ui.query("body").classes("projector" if is_large else "")
    with ui.row().classes("items-center w-full"):
        title = ui.label().classes("text-h5 title")
        ui.space()
        ui.link(
            say("projector"), address("/class", language=language, **({} if is_large else {"projector": "1"}))
        ).classes("run")
    table = ui.table(rows=[], columns=columns(leaderboard.columns(language)), row_key="name", pagination=0)
    table.classes("w-full class").props("flat bordered dense hide-pagination")
    add_cells(table, "classroom.vue")
    notes = ui.label().classes("text quiet")

    def state() -> object:
        judging.look()
        return judging.version, judging.now, judging.problem, studio.version

    def show() -> None:
        board = judging.board(language)
        title.text = say("Leaderboard: {}", board.env_id)
        table.rows = [*lines(studio, judging, board)]
        doing = say("evaluating {} ...", judging.now) if judging.now else ""
        explanation = f"{say(leaderboard.EPISODES, board.episodes)}. {say(PLACES)}" if board.rows else ""
        notes.text = "\n".join(filter(None, (doing, judging.problem, explanation, *leaderboard.notes(board))))

    follow(state, show)


def columns(titles: list[str]) -> list[JsonObject]:
    """Returns the columns of the table."""
    pairs = [*zip(NAMES, titles, strict=True)]
    pairs.insert(NAMES.index("interval") + 1, ("bar", ""))
    return [
        {
            "name": name,
            "label": title,
            "field": name,
            "align": "left" if name in ("place", "name", "algorithm", "bar") else "right",
            "classes": LEFT_OUT.get(name, ""),
            "headerClasses": LEFT_OUT.get(name, ""),
        }
        for name, title in pairs
    ]


def lines(studio: Studio, judging: Judging, board: Leaderboard) -> list[JsonObject]:
    """Returns the lines of the table: the models by mean return, then the runs that train and have no model yet."""
    ends = [end for row in board.rows for end in row.interval] or [0.0]
    scale = 100 / max(max(ends) - min(ends), 1e-9)
    running = {row.run: progress(row, board.language) for row in studio.rows if row.state == "running"}
    ranked: list[JsonObject] = []
    for row in board.rows:
        low, high = ((end - min(ends)) * scale for end in row.interval)
        path = judging.path_of(row.name)
        ranked.append(
            dict(zip(NAMES, leaderboard.cells_of(row, board.language), strict=True))
            | {"low": low, "width": high - low, "middle": (row.evaluation.mean_return - min(ends)) * scale - 1}
            | {"training": running.pop(row.name, ""), "watch": said("watch", language=board.language)}
            | {"link": path and address("/play", agent=path.as_posix(), watch="1")}
        )
    return [*ranked, *({"name": name, "training": steps} for name, steps in running.items())]


def progress(row: Row, language: Language) -> str:
    """Returns how far a run is."""
    asked = row.steps_asked
    share = f"{row.steps / asked:.0%}" if asked else f"{row.steps:,}"
    return said("trains: {}", leaderboard.written(share, language), language=language)
