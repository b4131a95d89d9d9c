"""Turns the links of the documentation to files of the repository into links to lines on the web.

A page links to a definition as ``[actor_loss](../src/rejeu/algorithms/sac/continuous.py#actor_loss)``, or to a method as
``...#Config.gradient_steps``. On GitHub the link opens the file. ``docs/conf.py`` replaces it by a link to the present lines
of the definition, so that no line number is written by hand.
"""

from __future__ import annotations

import ast
import os
import re
import tomllib
from collections.abc import Callable
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
FENCE = re.compile(r"\s*(`{3,})")
LINK = re.compile(r"\]\((?!\w+:)([^)#\s]*)(?:#([^)\s]*))?\)")
Definition = ast.FunctionDef | ast.ClassDef | ast.Assign | ast.AnnAssign


@cache
def base() -> str:
    """Returns the address of the repository from ``pyproject.toml``."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["urls"]["Source"]


@cache
def syntax_tree(path: Path) -> ast.Module:
    """Returns the syntax tree of a Python file."""
    return ast.parse(path.read_text(encoding="utf-8"))


def names(node: ast.stmt) -> list[str]:
    """Returns the names that a statement defines."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return [target.id for target in targets if isinstance(target, ast.Name)]


def lines(path: Path, name: str) -> tuple[int, int]:
    """Returns the first and the last line of a definition, such as ``make`` or ``Config.gradient_steps``.

    Nested functions count as members of the function around them, as in ``make.update``.

    Raises:
        LookupError: if the file does not define the name.
    """
    body: list[ast.stmt] = syntax_tree(path).body
    node: ast.stmt | None = None
    for identifier in name.split("."):
        node = next((statement for statement in body if identifier in names(statement)), None)
        if node is None:
            raise LookupError(f"{path.relative_to(ROOT).as_posix()} does not define {name}")
        body = getattr(node, "body", [])
    assert node is not None
    return node.lineno, node.end_lineno or node.lineno


def url(path: Path, name: str = "") -> str:
    """Returns the address of a file or folder of the repository, or of the lines of a definition in it.

    Raises:
        LookupError: if there is no such file or definition.
    """
    if not path.exists():
        raise LookupError(f"{path} does not exist")
    view = "tree" if path.is_dir() else "blob"
    address = f"{base()}/{view}/main/{path.relative_to(ROOT).as_posix()}"
    if not name:
        return address
    if path.suffix != ".py":
        return f"{address}#{name}"
    first, last = lines(path, name)
    return f"{address}#L{first}-L{last}"


def resolved(text: str, folder: Path, page_folder: Path, on_error: Callable[[str], object]) -> str:
    """Returns a page of Markdown whose links to files outside of ``docs`` are addresses on the web.

    Args:
        text: of the page; code blocks are not changed.
        folder: to which its links are relative.
        page_folder: to which they will be relative: another one where the text of one file is shown as another page.
        on_error: called with a message for each link that leads nowhere.
    """

    def replace(match: re.Match[str]) -> str:
        target, name = match[1], match[2] or ""
        path = Path(os.path.normpath(folder / target))
        if not target:
            return match[0]
        if path.is_relative_to(DOCS) and path.is_file():
            inside = Path(os.path.relpath(path, page_folder)).as_posix()
            return f"]({inside}#{name})" if name else f"]({inside})"
        try:
            return f"]({url(path, name)})"
        except LookupError as error:
            on_error(str(error))
            return match[0]

    result, fence = [], ""
    for line in text.splitlines(keepends=True):
        mark = FENCE.match(line)
        if mark and not fence:
            fence = mark[1]
        elif mark and line.strip() == fence:
            fence = ""
        result.append(line if fence or mark else LINK.sub(replace, line))
    return "".join(result)
