"""The language of a page, which each browser chooses, and texts in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

from nicegui.slot import Slot

from rejeu.core.language import LANGUAGES, Language, chosen, said, spoken

QUASAR: dict[Language, Literal["en-US", "fr"]] = {"en": "en-US", "fr": "fr"}
"""Languages by the names of NiceGUI, which has texts of its own."""


def language_here() -> Language:
    """Returns the language of the page that is built or has caused an event; the usual one elsewhere."""
    slots = Slot.get_stack()  # empty where no page is built; ui.context would make one
    name = slots[-1].parent.client.page.language if slots else None
    return next((language for language in LANGUAGES if QUASAR[language] == name), chosen())


def say(text: str, *values: object) -> str:
    """Returns a text in the language of the page, with values in place of its braces."""
    return said(text, *values, language=language_here())


def speaking(function: Callable[[], object]) -> Callable[[], object]:
    """Returns a function for a thread, whose texts are then in the language of the page that has made it."""
    language = language_here()

    def speak() -> None:
        spoken.set(language)
        function()

    return speak


def translated(texts: Mapping[str, str]) -> dict[str, str]:
    """Returns the choices of a control in the language of the page."""
    return {name: say(text) for name, text in texts.items()}
