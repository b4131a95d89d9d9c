"""The language of windows, grades, leaderboards and the pages of the studio. Everything else is in English."""

from __future__ import annotations

import os
import tomllib
from contextvars import ContextVar
from functools import cache
from importlib import resources
from typing import Literal, get_args

from rejeu.core.validation import choice

Language = Literal["en", "fr"]
LANGUAGES: tuple[Language, ...] = get_args(Language)
SETTING = "REJEU_LANGUAGE"
"""Environment variable with the language, English by default; ``speak`` in the notebooks of the courses sets it."""


spoken: ContextVar[Language | None] = ContextVar("spoken", default=None)
"""The language of a thread, where it is not that of all."""


def chosen(language: str | None = None) -> Language:
    """Returns a language, by default that of this thread, or else of :data:`SETTING`.

    Raises:
        ValueError: for an unknown one.
    """
    return choice("language", language or spoken.get() or os.environ.get(SETTING) or "en", LANGUAGES)


@cache
def french() -> dict[str, str]:
    """Returns the texts in French by those in English."""
    return tomllib.loads((resources.files("rejeu.core") / "language.toml").read_text(encoding="utf-8"))


def said(text: str, *values: object, language: Language | None = None) -> str:
    """Returns a text in a language, by default the chosen one, with values in place of its braces.

    >>> said("step {}", 3, language="fr"), said("a text without a translation", language="fr")
    ('pas 3', 'a text without a translation')
    """
    text = french().get(text, text) if chosen(language) == "fr" else text
    return text.format(*values) if values else text
