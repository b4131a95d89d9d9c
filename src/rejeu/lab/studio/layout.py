"""Elements of all pages: the frame with the navigation, and elements that are refreshed.

Texts of runs go into ``ui.label``, ``ui.table``, ``ui.select`` and the like, which show them as text. Nothing of a run goes
into ``ui.html``, ``ui.markdown``, ``ui.code``, the slots of a table as HTML, or a script.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from pathlib import Path
from types import MappingProxyType
from urllib.parse import urlencode

from fastapi import Request
from nicegui import ui

from rejeu.core.language import LANGUAGES, Language, chosen
from rejeu.core.records import brief
from rejeu.lab.studio import figures
from rejeu.lab.studio.speech import QUASAR, say

HERE = Path(__file__).parent
EVERY = 1.0
"""Seconds between two looks whether what a page shows has changed."""
MODES = {None: "brightness_auto", False: "light_mode", True: "dark_mode"}
"""Symbols of the colors of a page: those of the system, light and dark."""
LOST = "If the studio has ended, start it again and open the address that it prints."
"""Advice of a page whose connection is lost: a studio that was started again has another token."""
COOKIE = "rejeu_language"
"""Cookie of the browser with the language of the pages."""


@contextmanager
def frame(request: Request, title: str, path: str, links: Sequence[tuple[str, str]]) -> Iterator[None]:
    """Context whose elements are the content of a page.

    Args:
        request: whose address may name a ``language``, and a ``run`` for the title.
        title: of the page.
        path: of the page.
        links: path and title of each page in the navigation.
    """
    client = ui.context.client
    client.page = copy(client.page)  # its own, with the language of this browser
    language = asked_language(request)
    client.page.language = QUASAR[language]
    run = request.query_params.get("run") if path == "/run" else ""
    client.title = " · ".join(filter(None, [run, say(title), "rejeu"]))
    figures.add_colors()
    ui.add_css(HERE / "layout.css")
    # NiceGUI's message of a lost connection.
    ui.add_css(f'#popup::after {{ content: "{say(LOST)}"; max-width: 20rem; }}')
    ui.colors(primary="#2f6db5", positive="#1b7a43")
    dark = ui.dark_mode(None)
    with ui.header().classes("header items-center gap-1 no-wrap"):
        ui.label("rejeu").classes("text-subtitle1 text-weight-bold q-mr-sm gt-xs")
        with ui.row().classes("gap-0 no-wrap").style("overflow-x: auto"):
            for target, name in links:
                line = "text-decoration: underline; text-underline-offset: 6px" if target == path else ""
                ui.link(say(name), target).classes("text-white q-px-sm no-underline text-no-wrap").style(line)
        ui.space()
        other_language: Language = "en" if language == "fr" else "fr"
        ui.button(other_language, on_click=lambda: speak(other_language)).props(
            f"flat dense color=white aria-label='{say('français')}'"
        )
        ui.button(icon=MODES[None], on_click=lambda event: next_mode(event.sender, dark)).props(
            f"flat round dense color=white aria-label='{say('light or dark')}'"
        )
    with ui.column().classes("page"):
        ui.label(client.title).classes("unseen").props("role=heading aria-level=1")
        yield


def asked_language(request: Request) -> Language:
    """Returns the language that an address names, or a browser's cookie, or else the usual one."""
    asked = request.query_params.get("language") or request.cookies.get(COOKIE)
    return chosen(asked if asked in LANGUAGES else None)


def speak(language: Language) -> None:
    """Shows the page of this browser again, and later all pages, in a language."""
    ui.run_javascript(
        f"document.cookie = '{COOKIE}={language}; path=/; samesite=lax; max-age=31536000';"
        "const url = new URL(location); url.searchParams.delete('language'); location.replace(url);"
    )


def next_mode(button: ui.button, dark: ui.dark_mode) -> None:
    """Changes the colors of a page: those of the system, light, dark."""
    modes = [*MODES]
    dark.value = modes[(modes.index(dark.value) + 1) % len(modes)]
    button.props(f"icon={MODES[dark.value]}")


def action(text: str, icon: str | None, on_click: Callable[..., object]) -> ui.button:
    """Makes a small button."""
    return ui.button(text, icon=icon, on_click=on_click).props("outline dense no-caps padding='2px 10px'")


def env_select(ids: list[str], value: str | None = None) -> ui.select:
    """Makes a field in which an environment is chosen or typed; what is typed counts without Enter."""

    def take(text: str | None) -> None:
        env_id = completed(text or "", ids)
        if env_id and env_id != field.value:
            field.set_options([*dict.fromkeys((*ids, env_id))], value=env_id)

    field = ui.select(ids, label=say("environment"), value=value, with_input=True, new_value_mode="add-unique")
    field.on_value_change(lambda event: take(event.value))
    typed = "(event) => event.relatedTarget?.closest('.q-menu') || emit(event.target.value)"  # not while an option is clicked
    return field.on("focusout", lambda event: take(event.args), js_handler=typed)


def completed(text: str, ids: Sequence[str]) -> str:
    """Returns an id of an environment that was typed, or the first that begins like it.

    >>> [completed(text, ["CartPole-v1"]) for text in ("cartpole", "CartPole-v1", "my_env.py", "")]
    ['CartPole-v1', 'CartPole-v1', 'my_env.py', '']
    """
    matches = [env_id for env_id in ids if text and env_id.lower().startswith(text.lower())]
    return text if text in ids else next(iter(matches), text)


def add_cells(table: ui.table, file: str) -> None:
    """Gives a table the cells in a file next to this one: Vue's templates, which escape what they are given."""
    text = (HERE / file).read_text(encoding="utf-8")
    for name, template in re.findall(r'<template #([\w-]+)="props">\n(.*?)</template>', text, re.DOTALL):
        table.add_slot(name, template)


def form_buttons(form: ui.dialog, text: str, on_click: Callable[..., object], icon: str | None = None) -> ui.button:
    """Makes the buttons below a form over a page, which removes it when it is cancelled; returns the first."""
    with ui.row():
        button = ui.button(text, icon=icon, on_click=on_click).props("no-caps")
        ui.button(say("Cancel"), on_click=form.delete).props("flat no-caps")
    return button


@contextmanager
def failures_shown() -> Iterator[None]:
    """Context whose failure, of a file or for an invalid value, is shown for a few seconds."""
    try:
        yield
    except (OSError, ValueError) as error:
        ui.notify(brief(error), type="negative")


def follow(state: Callable[[], object], show: Callable[[], object]) -> None:
    """Calls a function now, and again whenever ``state`` returns something else, as long as the page is open."""
    previous: object = None

    def look() -> None:
        nonlocal previous
        if (now := state()) != previous:
            previous = now
            show()

    look()
    ui.timer(EVERY, look)


def address(path: str, **query: str | Sequence[str]) -> str:
    """Returns the address of a page with query parameters, which may hold anything.

    >>> address("/run", run="a b/<c>")
    '/run?run=a+b%2F%3Cc%3E'
    """
    return f"{path}?{urlencode(query, doseq=True, errors='surrogateescape')}" if query else path


class Choice:
    """The choices on a page. Mutable: the address has them, so that they survive a reload and can be sent.

    Args:
        request: whose address may name it. What is invalid there is as usual.
        usual: texts by parameter. What is as usual is left out of the address.
        valid: whether a text is valid, by parameter; without an entry all are.
        fixed: parameters that keep all their values.
    """

    def __init__(
        self,
        request: Request,
        usual: Mapping[str, str],
        valid: Mapping[str, Callable[[str], object]] = MappingProxyType({}),
        fixed: Sequence[str] = (),
    ) -> None:
        query = request.query_params
        asked = {name: query[name] for name in usual if name in query and valid.get(name, str)(query[name])}
        self.path, self.usual = request.url.path, usual
        self.values = {**usual, **asked}
        self.fixed = {name: query.getlist(name) for name in fixed if name in query}

    def __getitem__(self, name: str) -> str:
        return self.values[name]

    def change(self, **changed: str) -> None:
        """Chooses otherwise."""
        self.values |= changed
        ui.navigate.history.replace(self.address())

    def address(self, path: str | None = None, **more: str) -> str:
        """Returns the address of the page, or of another path with the same parameters."""
        changed = {name: value for name, value in self.values.items() if value != self.usual[name]}
        return address(path or self.path, **self.fixed, **changed, **more)


def is_number(text: str) -> bool:
    """Returns whether a text of an address is a whole number, of so many digits as a seed may have."""
    return text.isdecimal() and len(text) < 16
