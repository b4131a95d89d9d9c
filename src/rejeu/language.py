"""The language of what students read: windows, grades and leaderboards. Everything else is in English."""

from __future__ import annotations

import os
import tomllib
from functools import cache
from importlib import resources
from typing import Any, Literal, get_args

Language = Literal["en", "fr"]
LANGUAGES: tuple[Language, ...] = get_args(Language)
SETTING = "REJEU_LANGUAGE"
"""Environment variable with the language, English by default; ``speak`` in the notebooks of the courses sets it."""


def checked(language: str) -> Language:
    """Returns a language.

    Raises:
        ValueError: for an unknown one.
    """
    if language not in LANGUAGES:
        raise ValueError(f"language {language!r} must be one of {', '.join(LANGUAGES)}")
    return language


def chosen() -> Language:
    """Returns the language of :data:`SETTING`.

    Raises:
        ValueError: for an unknown one.
    """
    return checked(os.environ.get(SETTING) or "en")


@cache
def french() -> dict[str, str]:
    """Returns the texts in French by those in English."""
    return tomllib.loads((resources.files("rejeu") / "language.toml").read_text(encoding="utf-8"))


def said(text: str, *values: Any, language: Language | None = None) -> str:
    """Returns a text in a language, by default the chosen one, with values in place of its braces.

    >>> said("step {}", 3, language="fr"), said("a text without a translation", language="fr")
    ('pas 3', 'a text without a translation')
    """
    text = french().get(text, text) if (language or chosen()) == "fr" else text
    return text.format(*values) if values else text
