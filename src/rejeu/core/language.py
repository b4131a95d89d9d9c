"""The language of windows, grades, leaderboards and the pages of the studio. Everything else is in English."""

from __future__ import annotations

import os
import re
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
NUMBER = re.compile(r"(?<![\w.-])[\N{MINUS SIGN}-]?\d+(?:[.,]\d+)*%?(?!\w)|\N{EN DASH}")
"""A number in a text, or the dash of one that is unknown; not those in names, such as ``CartPole-v1``."""

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

    A text without values may have its numbers in it.

    >>> said("step {}", 3, language="fr"), said("step 3", language="fr"), said("without a translation", language="fr")
    ('pas 3', 'pas 3', 'without a translation')
    """
    if chosen(language) == "fr":
        pattern = text if values or text in french() or "{" in text else NUMBER.sub("{}", text)
        if pattern in french():
            text, values = french()[pattern], values if pattern == text else (*NUMBER.findall(text),)
    return text.format(*values) if values else text
