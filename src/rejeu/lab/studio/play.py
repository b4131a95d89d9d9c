"""The page on which environments are played by keys, alone or beside agents, and agents are watched."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from functools import partial

from fastapi import Request
from nicegui import ui

from rejeu.agents import presets
from rejeu.lab.studio.games import HostedGame, asked_game
from rejeu.lab.studio.layout import address, env_select, follow, is_number
from rejeu.lab.studio.screen import CSS, Screen
from rejeu.lab.studio.speech import say
from rejeu.lab.studio.state import Studio
from rejeu.teaching.play import Opened
from rejeu.teaching.play.game import Event
from rejeu.teaching.play.keys import KNOWN, KeyMap
from rejeu.teaching.play.window import HELP, legend

MOST_AGENTS = 2
LOOK = 0.1
"""Seconds between two looks whether a game has begun or ended."""
CHIP = 'outline no-caps padding="4px 10px"'


def build(studio: Studio, request: Request) -> None:
    """Makes the page, a form and the game.

    Its address may name ``env``, ``agent`` once or twice, a ``seed``, and ``watch`` for a game without keys; it then begins.
    """
    ui.add_css(CSS)
    ui.query(".page").classes("fits")
    asked = request.query_params
    names = asked.getlist("agent")[:MOST_AGENTS]
    first = studio.row(names[0]) if names else None
    env_id = asked.get("env") or (first.env if first is not None else None)
    seed = asked.get("seed", "")
    with (
        ui.expansion(say("Environment and players"), value=not (env_id or names))
        .props("dense")
        .classes("w-full") as form,
        ui.row().classes("items-center w-full"),
    ):
        env = env_select(environments(studio, env_id), env_id).classes("w-64")
        choices = offered(studio, env_id, names)
        agents = ui.select(choices, label=say("agents"), value=names, multiple=True).classes("w-64")
        agents.props(f"use-chips max-values={MOST_AGENTS}")
        by_hand = ui.switch(say("I play"), value="watch" not in asked)
        record = ui.switch(say("record")).bind_enabled_from(by_hand, "value")
        usual_seed = int(seed) if is_number(seed) else None
        number = ui.number(say("seed"), value=usual_seed, min=0, precision=0).classes("w-20")
        start = ui.button(say("Start"), icon="play_arrow").props("no-caps")
    stage = ui.column().classes("stage w-full")

    def start_anew() -> None:
        seed = "" if number.value is None else str(int(number.value))
        query = {"env": env.value or "", "agent": agents.value, "seed": seed, "watch": [] if by_hand.value else [""]}
        ui.navigate.history.replace(address("/play", **{name: value for name, value in query.items() if value}))
        begin()

    def begin() -> None:
        from_seed = None if number.value is None else int(number.value)
        players = tuple(agents.value), bool(by_hand.value)
        start = partial(asked_game, studio, env.value or "", *players, from_seed, bool(record.value))
        form.value = False
        stage.clear()  # the screen of an earlier game ends it
        with stage:
            show(start, offer, begin)

    def offer(env_id: str | None = None) -> None:
        env_id = env.value or env_id
        for control, value, options in (
            (env, env_id, environments(studio, env_id)),
            (agents, agents.value, offered(studio, env_id, agents.value)),
        ):
            if (control.options, control.value) != (options, value):
                control.set_options(options, value=value)

    env.on_value_change(lambda: offer())
    follow(lambda: studio.version, offer)
    start.on_click(start_anew)
    if env_id or names:
        begin()


def environments(studio: Studio, selected: str | None) -> list[str]:
    """Returns the ids of environments with presets, with keys, and of the runs, and the one that is chosen."""
    ids = [*(preset.env_id for preset in presets.every()), *(row.env for row in studio.rows), selected]
    return sorted({*KNOWN, *filter(None, ids)})


def offered(studio: Studio, env_id: str | None, selected: list[str]) -> list[str]:
    """Returns the names of the agents that play an environment, and of those that are chosen."""
    runs = [row.run for row in studio.rows if row.env == env_id]
    return [*dict.fromkeys([*selected, *studio.guests, *runs])]


def show(
    start: Callable[[], AbstractContextManager[Opened]], begun: Callable[[str], object], again: Callable[[], object]
) -> None:
    """Begins a game, and shows it.

    Args:
        start: returns the context of the game.
        begun: called with the id of its environment.
        again: called to begin it anew, when it has ended.
    """
    keycaps: dict[ui.button, str] = {}
    labels: dict[str, str] = {}

    def label(learned: dict[str, str]) -> None:
        labels.update(learned)
        for button, text in keycaps.items():
            button.text = labelled(text, labels)

    status = ui.label(say("The environment is made, and agents are compiled ...")).classes("text")
    screen = Screen(lambda event: playing.handle(event), label)
    buttons = ui.row().classes("keys gap-1 items-center w-full")
    playing = HostedGame(start, screen.show)
    screen.on_leave = lambda: playing.handle(Event("close"))

    def look() -> None:
        if playing.opened is not None and not buttons.default_slot.children:
            status.text = ""
            begun(playing.opened.env_id)
            with buttons:
                keycaps.update(show_keys(playing, playing.opened.keys))
            label({})
        if playing.ended:
            timer.deactivate()
            keycaps.clear()
            buttons.clear()
            status.text = playing.said or say("The game has ended.")
            with buttons:
                ui.button(say("again"), icon="replay", on_click=again).props("no-caps")

    timer = ui.timer(LOOK, look)


def show_keys(playing: HostedGame, keys: KeyMap | None) -> dict[ui.button, str]:
    """Shows what each key does, as buttons that are that key; returns their keys, by SDL's names."""
    keycaps: dict[ui.button, str] = {}
    together = "gap-1 items-center no-wrap q-mr-sm"
    for entry in [] if keys is None else legend(keys):
        with ui.row().classes(together):
            for text, _ in entry.keys:
                button = ui.button(text).props(CHIP).classes("key")
                for name in ("pointerdown", "pointerup", "pointerleave", "pointercancel"):
                    event_type = "press" if name == "pointerdown" else "release"
                    button.on(name, partial(playing.handle_all, event_type, text.split("+")))
                keycaps[button] = text
            ui.label(say(entry.label)).classes("text-caption")
    for key, label in HELP:
        with ui.row().classes(together):
            button = ui.button(key, on_click=partial(playing.handle_all, "press", [key])).props(CHIP).classes("key")
            ui.label(say(label)).classes("text-caption")
        keycaps[button] = key
    return keycaps


def labelled(text: str, labels: Mapping[str, str]) -> str:
    """Returns the text of keys, with what stands on them.

    >>> labelled("a+w", {"a": "q", "w": "z"}), labelled("left", {"a": "q"})
    ('q+z', 'left')
    """
    return "+".join(labels.get(key, key) for key in text.split("+"))
