"""Courses as notebooks: exercises and solutions, in English and French, from one source each.

:mod:`rejeu.courses.notebooks` describes how to write one, :mod:`rejeu.courses.checks` how answers are checked.
"""

from rejeu.courses.games import by_hand
from rejeu.courses.notebooks import LANGUAGES, Language, Version, minutes, notebook, sources, steps, text, write

__all__ = ["LANGUAGES", "Language", "Version", "by_hand", "minutes", "notebook", "sources", "steps", "text", "write"]
