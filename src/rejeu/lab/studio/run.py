"""The page of a run: the agent live, curves that grow, episodes that are shown again, settings, warnings and the log."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from fastapi import Request
from nicegui import ui

from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core import atomic
from rejeu.core.errors import one_line
from rejeu.core.types import JsonObject
from rejeu.lab.experiments.work import HIDDEN
from rejeu.lab.reporting import run_list
from rejeu.lab.reporting.report import sections
from rejeu.lab.reporting.rows import SHARE, Row, rate_text, steps_text
from rejeu.lab.runs import requests
from rejeu.lab.runs.read import Remarks, is_file
from rejeu.lab.studio import moving, processes
from rejeu.lab.studio.branch import open_form
from rejeu.lab.studio.figures import Figure, add_scripts
from rejeu.lab.studio.layout import EVERY, Choice, action, address, failures_shown, form_buttons, is_number
from rejeu.lab.studio.player import BEST, CURRENT, LiveEpisode, LivePlayer, lower_priority
from rejeu.lab.studio.runs import COLORS
from rejeu.lab.studio.screen import CSS, Screen
from rejeu.lab.studio.speech import say, translated
from rejeu.lab.studio.state import Studio
from rejeu.lab.studio.then_and_now import ThenAndNow
from rejeu.logs import charts
from rejeu.logs.charts import Chart

FIRST = (sections.CURVES, sections.GOALS)
"""Headings of the charts that are open; the others are folded."""
AXES = {"x": "steps", "t": "time"}
USUAL = {"policy": CURRENT, "seed": "", "axis": "x"}
VALID = {
    "policy": lambda name: name in (CURRENT, BEST) or requests.MODEL.fullmatch(f"{name}.safetensors"),
    "seed": is_number,
    "axis": AXES.__contains__,
}
REPLAYS = 100
SLOW = 0.2
"""Speed of slow motion."""
READING = ThreadPoolExecutor(1, initializer=lower_priority)
"""Where runs are read; training goes first."""
SEEN = """<script>document.addEventListener("visibilitychange", () => emitEvent("seen", !document.hidden));</script>"""
TITLE = "Returns of the trained agent: choose a bar, then an episode, which is shown again"
EPISODES = [
    {"name": name, "label": name, "field": name, "align": "right", "sortable": True}
    for name in ("seed", "return", "length", "success")
]


def build(studio: Studio, request: Request) -> None:
    """Makes the page of the run that the address names."""
    name = request.query_params.get("run", "")
    row = studio.row(name)
    if row is None or row.state == "unread":
        message = ui.label().classes("text")

        def look() -> None:
            row = studio.row(name)
            is_missing = studio.version and row is None
            text = "there is no run of this name below the folder" if is_missing else "reading the folder"
            message.text = f"{say(text)}: {name}"
            if row is not None and row.state != "unread":
                ui.navigate.reload()

        look()
        ui.timer(EVERY, look)
        return
    ui.add_css(CSS)
    add_scripts()
    RunPage(studio, name, row.path, Choice(request, USUAL, VALID, ["run"]))


class RunPage:
    """The page of one run. Mutable: it follows the run."""

    def __init__(self, studio: Studio, name: str, path: Path, choice: Choice) -> None:
        self.studio, self.name, self.path, self.choice = studio, name, path, choice
        self.figures: dict[str, Figure] = {}
        self.grids: dict[str, ui.element] = {}
        self.maps: dict[str, Chart] = {}
        self.map_notes: dict[str, ui.label] = {}
        self.row: Row | None = None
        self.due = 0.0
        self.is_ours = name in studio.summaries and is_file(RunFolder(path).config)
        self.head = Head(self)
        with ui.row().classes("w-full items-start gap-4"):
            with ui.column().classes("col-grow gap-2").style("flex-basis: 320px; max-width: 720px"):
                self.live = LiveView(self) if self.is_ours else None
            with ui.column().classes("gap-2").style("flex: 1 1 300px"):
                self.tiles = ui.row().classes("gap-2 w-full")
                self.values = Values() if self.is_ours else None
        if self.is_ours:
            ThenAndNow(RunFolder(path), studio.given(name))
        with ui.row().classes("items-center w-full"):
            self.axis = ui.toggle(translated(AXES), value=choice["axis"], on_change=self.turn).props("dense no-caps")
        self.groups = ui.column().classes("w-full gap-2")
        self.episodes = Episodes(self)
        with ui.expansion(say("Settings")).classes("w-full"):
            self.settings = ui.column().classes("w-full")
        with ui.expansion(say("Log")).classes("w-full") as log:
            self.log = ui.label().classes("text mono quiet")
        log.on_value_change(self.show_log)
        ui.timer(EVERY, self.look)

    async def look(self) -> None:
        """Shows the run again if it has changed."""
        row = self.studio.row(self.name)
        if row is not None and row.state == "running":
            self.head.show_progress(row)
        if row is None or row == self.row or time.monotonic() < self.due:
            return
        began, self.row = time.monotonic(), row
        parts = None
        try:
            if self.name in self.studio.summaries:  # else its row says why it cannot be read
                parts = await asyncio.get_running_loop().run_in_executor(READING, read, self.path)
        except Exception as error:  # files can hold anything; it is not read again each second
            row = replace(row, notes=(*row.notes, one_line(error)))
        self.due = time.monotonic() + SHARE * (time.monotonic() - began)
        self.show(row, parts)

    def show(self, row: Row, parts: sections.Parts | None) -> None:
        """Shows what was read."""
        self.head.show(row, None if parts is None else parts.runs[0])
        if parts is None:
            return
        section = parts.runs[0]
        self.tiles.clear()
        with self.tiles:
            for tile in section.tiles:
                show_tile(tile)
        self.show_charts(section.groups, parts.data["charts"])
        histograms = parts.data["histograms"]
        has_model = bool(section.replay_command)
        self.episodes.show(histograms.get("run0-replays"), histograms.get("run0-episodes"), has_model)
        if not self.settings.default_slot.children:
            with self.settings:
                show_settings(section)
        self.show_log()

    def show_charts(self, groups: list[sections.ChartGroup], data: dict[str, charts.Chart]) -> None:
        """Draws charts, and adds those that are new."""
        for title, entries in groups:
            if title not in self.grids:
                with self.groups, ui.expansion(say(title), value=title in FIRST).classes("w-full"):
                    self.grids[title] = ui.element("div").classes("charts w-full")
            for entry in entries:
                is_map = "places" in data[entry.id]
                if entry.id not in self.figures:
                    with self.grids[title], ui.card().classes("card").props("flat bordered"):
                        ui.label(say(entry.title)).classes("text-weight-medium text")
                        choose = partial(self.watch_goal, entry.id) if is_map else None
                        height = "340px" if is_map else "240px"
                        self.figures[entry.id] = Figure(say(entry.title), height=height, choose=choose)
                        self.map_notes |= {entry.id: ui.label().classes("text-caption quiet")} if is_map else {}
                if is_map:
                    self.maps[entry.id] = data[entry.id]
                    self.map_notes[entry.id].text = say(entry.note)
                else:
                    self.figures[entry.id].show(data[entry.id], axis=self.axis.value)
        self.show_maps()

    def show_maps(self) -> None:
        """Draws the maps of goals, on a picture of the environment where goals have a place in it."""
        view = None if self.live is None else self.live.player.goal_view
        for entry_id, chart in self.maps.items():
            self.figures[entry_id].show(chart if view is None else view.draw(chart))

    def watch_goal(self, entry_id: str, number: int) -> None:
        """Shows an episode with a goal at a place of a map: the next one that was played, or of the current policy."""
        places = self.maps[entry_id]["places"]
        if self.live is None or not 0 <= number < len(places):
            return
        seed = next_seed(places[number]["seeds"], self.live.player.seed)
        if seed is None:
            self.live.choose(CURRENT, goal=places[number]["goal"])
            ui.notify(say("The current policy acts from a start with the goal nearest to this place."))
        else:
            self.episodes.watch({"seed": seed})

    def turn(self) -> None:
        """Draws all charts over another axis."""
        self.choice.change(axis=self.axis.value)
        for figure in self.figures.values():
            figure.show(axis=self.axis.value)

    def show_log(self) -> None:
        """Shows the end of the log."""
        none = say("There is none: the studio did not start this run, nor a sweep.")
        self.log.text = processes.read_log(self.path) or none


def next_seed(seeds: Sequence[float | None], current: int | None) -> int | None:
    """Returns the seed after the current one, or the first; None if none is known.

    >>> next_seed([3.0, 7.0], 3), next_seed([3.0, 7.0], 7), next_seed([3.0, 7.0], None), next_seed([None], 3)
    (7, 3, 3, None)
    """
    numbers = [int(seed) for seed in seeds if seed is not None]
    return numbers[(numbers.index(current) + 1) % len(numbers) if current in numbers else 0] if numbers else None


def read(path: Path) -> sections.Parts:
    """Returns the content of the report on a run."""
    return sections.build([run_list.read(path)], None)


def show_actions(page: RunPage, row: Row) -> None:
    """Shows buttons for what the state of a run allows."""
    folder = RunFolder(page.path)
    is_alone = not (page.path.parent / HIDDEN).is_dir()  # a sweep would continue a run that stops
    if row.state == "running" and page.is_ours and is_alone:
        action(say("Stop"), "stop", lambda event: stop(event.sender, folder))
    if row.state in ("paused", "interrupted", "crashed") and page.is_ours:
        text = say("The run continues from its newest checkpoint.")
        action(say("Resume"), "play_arrow", lambda event: command(event.sender, "resume", page, text))
    if page.is_ours:
        play = address("/play", agent=page.name)
        action(say("Play"), "sports_esports", lambda: ui.navigate.to(play))
        action(say("Branch"), "call_split", lambda: open_form(page.studio, page.name, page.path))
        action(say("Note"), "edit_note", lambda: edit_remarks(page, row))
    if row.state != "running":
        action(say("Rename"), "drive_file_rename_outline", lambda: rename_run(page))
        action(say("Delete"), "delete", lambda: delete_run(page))
    ui.link(say("save this page"), address("/save/run", run=page.name)).classes("run self-center")


def edit_remarks(page: RunPage, row: Row) -> None:
    """Opens a form for the note and the tags of a run."""

    def save() -> None:
        with failures_shown():
            Remarks(note.value or "", (*(tags.value or "").split(),)).write(RunFolder(page.path))
            form.delete()

    with ui.dialog(value=True) as form, ui.card().classes("w-full").style("max-width: 30rem"):
        note = ui.textarea(say("note"), value=row.remarks.note).classes("w-full")
        tags = ui.input(say("tags, with spaces between them"), value=" ".join(row.remarks.tags)).classes("w-full")
        form_buttons(form, say("Save"), save)


def rename_run(page: RunPage) -> None:
    """Opens a form for another name of a run, and leads to its page."""

    def save() -> None:
        with failures_shown():
            moving.rename(page.studio, page.name, name.value or "")
            ui.navigate.to(address("/run", run=name.value))

    with ui.dialog(value=True) as form, ui.card().classes("w-full").style("max-width: 30rem"):
        name = ui.input(say("folder"), value=page.name).classes("w-full")
        form_buttons(form, say("Rename"), save)


def delete_run(page: RunPage) -> None:
    """Moves a run into the bin, and leads to the page of all runs, where that can be undone."""
    with failures_shown():
        moving.delete(page.studio, [page.name])
        ui.navigate.to("/")


def stop(button: Any, folder: RunFolder) -> None:
    """Asks the run to stop with a checkpoint, as Ctrl-C does."""
    with failures_shown():
        atomic.touch(folder.stop)
        ui.notify(say("The run stops after this step, and saves everything."))
        disable_while(button, lambda: is_file(folder.stop))


def command(button: Any, name: str, page: RunPage, text: str, *words: str) -> None:
    """Starts a command about a run in a process of its own, and says so or why not, also when it has ended with an error."""

    def is_under_way() -> bool:
        if process.poll():
            ui.notify(processes.last_line(page.path), type="negative")
        return process.returncode is None

    with failures_shown():
        process = processes.start([name, str(page.path), *words, *page.studio.words(page.name)], page.path)
        ui.notify(text)
        disable_while(button, is_under_way)


def disable_while(button: Any, is_under_way: Callable[[], bool]) -> None:
    """Disables a button while what it asked for is under way. Other buttons come when the state changes."""

    def look() -> None:
        if not is_under_way():
            button.enable()
            timer.cancel()

    button.disable()
    timer = ui.timer(EVERY, look)


def show_tile(tile: sections.Tile) -> None:
    """Shows a figure of the headline."""
    with ui.card().classes("card tile").props("flat bordered"):
        texts = [say(tile.title), *([say("step {}", tile.step)] if tile.step else [])]
        ui.label(", ".join(texts)).classes("text-caption quiet")
        ui.label(tile.value).classes("text-h6")
        for text in filter(None, (tile.note, tile.more)):
            ui.label(say(text)).classes("text-caption quiet")


def show_settings(section: sections.RunSection) -> None:
    """Shows the settings, first those that differ from the defaults."""
    names = ("name", "value", "default")
    columns = [{"name": name, "label": "", "field": name, "align": "left"} for name in names]
    changed = [(name, value, say("default {}", default)) for name, value, default in section.changed]
    usual = [(name, value, "") for name, value in section.settings]
    for title, rows in (("Different from the defaults", changed), ("Run", usual), ("Others", section.unchanged)):
        if rows:
            ui.label(say(title)).classes("text-weight-medium")
            cells = [dict(zip(names, row, strict=True)) for row in rows]
            ui.table(rows=cells, columns=columns).props("flat dense hide-header wrap-cells").classes("w-full text")
    if section.run.command:
        ui.label(section.run.command).classes("text mono quiet")


class Head:
    """Environment and state of the run, buttons, and its warnings and notes. Mutable."""

    def __init__(self, page: RunPage) -> None:
        self.page = page
        self.state, self.problems = "", ()  # type: str, tuple[str, ...]
        with ui.row().classes("items-center gap-2 w-full"):
            self.env, self.algorithm = ui.label().classes("text-h6 text"), ui.label().classes("text-h6 quiet")
            self.badge = ui.badge()
            ui.space()
            self.actions = ui.row().classes("gap-2")
        self.progress = ui.linear_progress(show_value=False).props(f"instant-feedback aria-label='{say('progress')}'")
        self.status = ui.label().classes("text")
        self.facts, self.remarks = ui.label().classes("quiet text"), ui.label().classes("text")
        self.notes = ui.column().classes("w-full gap-1")

    def show(self, row: Row, section: sections.RunSection | None) -> None:
        """Shows the row of a run, and its section of the report if it could be read. Buttons stay while the state does."""
        self.env.text, self.algorithm.text = row.env or row.name, row.algorithm
        self.facts.text = " · ".join([row.run, *(() if section is None else map(say, section.facts))])
        tags = " ".join(f"#{tag}" for tag in row.remarks.tags)
        self.remarks.text = " · ".join(filter(None, [tags, row.remarks.note]))
        self.remarks.set_visibility(bool(self.remarks.text))
        if row.state != self.state:
            self.state, self.badge.text = row.state, say(row.state)
            self.badge.props(f"color={COLORS.get(self.state, 'grey-7')}")
            self.actions.clear()
            with self.actions:
                show_actions(self.page, row)
        for element in (self.progress, self.status):
            element.set_visibility(row.state == "running")
        problems = (*row.warnings, *row.notes) if section is None else (*section.run.warnings, *section.notes)
        if problems != self.problems:
            self.problems = problems
            self.notes.clear()
            with self.notes:
                for text in problems:
                    ui.label(text).classes("warning text")

    def show_progress(self, row: Row) -> None:
        """Shows how far training is: a bar, and what it has printed last; of one without a log what its files say."""
        self.progress.value = row.share or 0.0
        self.progress.props["indeterminate"] = row.share is None
        how_far = say(row.reason) or f"{steps_text(row)} · {rate_text(row)}"
        self.status.text = processes.last_line(self.page.path) or how_far


class LiveView:
    """The agent that acts, and who of the course of training it is. Mutable."""

    def __init__(self, page: RunPage) -> None:
        self.page, self.steps = page, [CURRENT, BEST]
        self.screen = Screen()
        self.status = ui.label(say("the agent is loaded")).classes("quiet text")
        with ui.row().classes("items-center w-full no-wrap gap-4"):
            self.slider = ui.slider(min=0, max=1, value=0, on_change=self.chosen).props(f"aria-label='{say('policy')}'")
            self.label = ui.label().classes("quiet").style("min-width: 9em")
            action(say("best"), None, lambda: self.choose(BEST))
        with ui.row().classes("items-center gap-2"):
            self.pause = action(say("pause"), "pause", self.turn_pause)
            action(say("one step"), "skip_next", self.step)
            slow = ui.checkbox(say("slow motion")).props("dense")
        self.player = LivePlayer(page.path, page.studio.given(page.name), self.screen.show, is_seen=False)
        slow.on_value_change(lambda event: setattr(self.player, "speed", SLOW if event.value else 1.0))
        self.screen.on_leave = self.player.close
        self.choose(page.choice["policy"], int(page.choice["seed"]) if page.choice["seed"] else None)
        ui.add_body_html(SEEN)
        # Once it is connected.
        ui.timer(0.0, lambda: ui.run_javascript("emitEvent('seen', !document.hidden)"), once=True)
        ui.on("seen", lambda event: setattr(self.player, "is_seen", bool(event.args)))
        ui.timer(EVERY, self.look)

    def step(self) -> None:
        """Takes one step."""
        self.player.step()
        self.name()

    def turn_pause(self) -> None:
        """Pauses, or goes on."""
        self.player.is_paused = not self.player.is_paused
        self.name()

    def look(self) -> None:
        """Offers policies that are new, and shows what the critic expected."""
        models = [path.stem for path in requests.models(RunFolder(self.page.path).models)]
        steps = [*models, CURRENT, BEST]
        if steps != self.steps:
            self.steps = steps
            self.slider.props(f"max={len(steps) - 1}")
        self.name()
        self.status.text = say(self.player.problem)
        self.page.show_maps()
        if self.page.values is not None:
            self.page.values.show(self.player.complete or self.player.episode, self.player.gamma)

    def name(self) -> None:
        """Says which policy acts, and moves the slider there."""
        model, is_paused = self.player.model, self.player.is_paused
        self.pause.text = say("continue") if is_paused else say("pause")
        self.pause.props(f"icon={'play_arrow' if is_paused else 'pause'}")
        if model in self.steps:
            self.slider.value = self.steps.index(model)
        names = {CURRENT: say("current policy"), BEST: say("best policy")}
        self.label.text = names.get(model) or say("after {} steps", f"{int(model.removeprefix('step_')):,}")

    def chosen(self) -> None:
        """Lets the policy at the slider act."""
        model = self.steps[min(int(self.slider.value), len(self.steps) - 1)]
        if model != self.player.model:
            self.choose(model)

    def choose(self, model: str, seed: int | None = None, goal: Sequence[float] | None = None) -> None:
        """Lets a policy act, from a seed or to a goal if one is given."""
        if goal is not None or (model, seed) != (self.player.model, self.player.seed):
            self.player.choose(model, seed, goal)
            if (seed, goal) != (None, None):  # it was chosen further down the page
                ui.run_javascript(
                    f"getHtmlElement({self.screen.id}).scrollIntoView({{behavior: 'smooth', block: 'nearest'}})"
                )
            self.page.choice.change(policy=model, seed="" if seed is None else str(seed))
            self.name()


class Values:
    """Values that the critic gave to the steps of an episode, and the returns to go. Mutable."""

    def __init__(self) -> None:
        with ui.card().classes("card w-full").props("flat bordered") as self.card:
            self.title = ui.label().classes("text-weight-medium text")
            self.figure = Figure(say("Value of each step"))
        self.card.set_visibility(False)

    def show(self, episode: LiveEpisode | None, gamma: float) -> None:
        """Draws an episode, as far as it is."""
        if episode is not None and episode.rewards:
            self.card.set_visibility(True)
            self.title.text = say("Value of each step, seed {}", episode.seed)
            to_go = episode.to_go(gamma) if episode.is_over else np.zeros(0)
            expected = episode.expected if episode.is_cut else None
            self.figure.show(charts.value_chart(np.array(episode.values), to_go, expected))


class Episodes:
    """Histograms of returns, and the episodes behind a bar. Mutable."""

    def __init__(self, page: RunPage) -> None:
        self.page = page
        self.histogram: Chart | None = None
        with ui.expansion(say("Episodes"), value=True).classes("w-full"):
            self.title = ui.label().classes("text")
            self.figure = Figure(say("Returns of the trained agent"), height="200px", choose=self.choose)
            self.play = action(say("Play {} episodes", REPLAYS), "replay", lambda event: self.replay(event.sender))
            self.play.set_visibility(False)
            columns = [column | {"label": say(str(column["label"]))} for column in EPISODES]
            self.table = ui.table(rows=[], columns=columns, row_key="seed", pagination=10).props("flat dense")
            self.table.on("rowClick", lambda event: self.watch(event.args[1]))
            self.table.set_visibility(False)
            self.training_title = ui.label(say("Returns of the training episodes")).classes("text")
            self.training = Figure(say("Returns of the training episodes"), height="200px")

    def show(self, replays: JsonObject | None, training: Chart | None, has_model: bool) -> None:
        """Draws the histograms."""
        self.histogram = replays
        self.title.text = say(TITLE) if replays else ""
        self.figure.set_visibility(replays is not None)
        self.play.set_visibility(has_model)
        self.training_title.set_visibility(training is not None)
        if replays is not None:
            self.figure.show(replays)
        if training is not None:
            self.training.show(training)

    def choose(self, bar: int) -> None:
        """Lists the episodes of a bar."""
        h = self.histogram
        if h is None or not 0 <= bar < len(h["rows"]):
            return
        self.figure.show(chosen=bar)
        self.table.rows = [dict(zip(h["columns"], row, strict=True)) for row in h["rows"][bar]]
        self.table.set_visibility(True)
        self.table.update()

    def watch(self, episode: JsonObject) -> None:
        """Shows an episode again: the best policy acts from its seed."""
        if self.page.live is not None and isinstance(seed := episode.get("seed"), int):
            self.page.live.choose(BEST, seed)
            ui.notify(say("The best policy acts from the seed {}.", seed))

    def replay(self, button: Any) -> None:
        """Lets the best policy play episodes from known seeds, in a process of its own."""
        text = say("The best policy plays {} episodes; they are listed here when it has finished.", REPLAYS)
        command(button, "report", self.page, text, "--replay", str(REPLAYS))
