"""The right answers of the courses, taken from their solutions."""

import ast
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rejeu.teaching import courses
from rejeu.teaching.courses import notebooks


def text_of(source: Any, language: str) -> str:
    """Returns the solution of a course as a text notebook."""
    document = notebooks.notebook(source.read_text(encoding="utf-8"), language, "solution")
    return notebooks.jupytext().writes(document, "py:percent")


def solution(number: int, checks: ModuleType) -> SimpleNamespace:
    """Returns the functions of a course's solution that have a check, by name."""
    tree = ast.parse(text_of(courses.sources()[number - 1], "en"))
    defined = [node for node in tree.body if isinstance(node, ast.FunctionDef) or getattr(node, "name", None) == "Step"]
    names: dict[str, Any] = {"jax": jax, "jnp": jnp, "np": np, "Any": Any, "NamedTuple": NamedTuple}
    exec(compile(ast.Module(defined, []), f"course {number}", "exec"), names)
    return SimpleNamespace(**{node.name: names[node.name] for node in defined if hasattr(checks, node.name)})
