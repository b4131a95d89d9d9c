"""Grading of notebooks: which checks a student's answers pass.

The imports, definitions and checks of a notebook are executed, and its trainings and figures are left out. So a notebook takes
seconds, and what it printed before does not matter. It has a process of its own, with a time limit.
"""

from __future__ import annotations

import ast
import contextlib
import io
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

from rejeu.core import interrupt
from rejeu.core.language import Language, chosen, said
from rejeu.core.types import Variables
from rejeu.teaching.courses import checks
from rejeu.teaching.courses.notebooks import jupytext

SECONDS = 120.0
"""Time limit of a notebook."""
MODULES = {"jax", "jnp", "math", "np"}
"""Modules whose functions may be called for a constant, such as ``np.linspace(0, 1)``."""
SPEAK = re.compile(r"""^speak\(["'](en|fr)["']\)""", re.MULTILINE)
MAX_BYTES = 64 * 2**20
"""Largest notebook, with its figures."""


class Grade(NamedTuple):
    """Results of the checks of a notebook."""

    path: Path
    found: dict[str, str | None]
    """By check, in the order of the notebook: nothing if the answer is right, else the message; None if it did not run."""
    error: str = ""
    """Why the notebook could not be graded."""
    language: Language = "en"
    """Of the notebook."""

    @property
    def n_passed(self) -> int:
        """The number of checks that passed."""
        return sum(problem == "" for problem in self.found.values())


def grade(path: Path, seconds: float = SECONDS) -> Grade:
    """Executes the definitions and checks of a notebook (.ipynb or .py) in a process of its own.

    Raises:
        MissingExtra: if jupytext is not installed.
        OSError: if the file cannot be read.
    """
    if path.stat().st_size > MAX_BYTES:
        return Grade(path, {}, said("it is larger than {} MiB", MAX_BYTES // 2**20))
    try:
        cells = [cell.source for cell in jupytext().read(path).cells if cell.cell_type == "code"]
    except Exception as error:  # jupytext and nbformat raise errors of many kinds
        return Grade(path, {}, said("it is not a notebook ({})", checks.short(error)))
    names = [name for cell in cells for name in _checks(cell)]
    if not names:
        return Grade(path, {}, said("it has no checks of a course"))
    spoken = SPEAK.search("\n".join(cells))
    language = chosen(spoken and spoken[1])
    command = interrupt.program("-c", "from rejeu.teaching.courses.grading import main; main()")
    quiet = {"MPLBACKEND": "agg", "PYTHONIOENCODING": "utf-8"}
    say, problems, why = partial(said, language=language), {}, ""
    try:
        done = subprocess.run(
            command,
            input=json.dumps(cells),
            capture_output=True,
            encoding="utf-8",
            timeout=seconds,
            env=os.environ | quiet,
            check=False,
        )
        problems = json.loads(done.stdout.splitlines()[-1])
    except subprocess.TimeoutExpired:
        why = say("it took longer than {:g} seconds", seconds)
    except (IndexError, ValueError):
        why = say("its process ended ({})", checks.short(done.stderr[-160:]))
    return Grade(path, {name: problems.get(name) for name in names}, why, language)


def main() -> None:
    """Executes the cells that come as JSON on standard input, and prints what the checks found as the last line."""
    sys.path.append(os.getcwd())  # last, as `rejeu` does
    cells = json.load(sys.stdin)
    with contextlib.redirect_stdout(io.StringIO()):
        execute(cells)
    print(json.dumps(checks.SESSION.found), flush=True)
    os._exit(0)  # whatever a notebook has started ends here


def execute(cells: list[str]) -> None:
    """Executes the imports, definitions, constants and checks of cells. A statement that raises is left out."""
    names: Variables = {"__name__": "__main__"}
    for cell in cells:
        for statement in _statements(cell):
            if _is_needed(statement):
                with contextlib.suppress(Exception, SystemExit):
                    exec(compile(ast.Module([statement], []), "<notebook>", "exec"), names)  # noqa: S102


def _statements(cell: str) -> list[ast.stmt]:
    """Returns the statements of a cell without magics, none if it is not valid Python."""
    lines = ["" if line.lstrip().startswith(("%", "!")) else line for line in cell.splitlines()]
    try:
        return ast.parse("\n".join(lines)).body
    except SyntaxError:
        return []


def _checks(cell: str) -> Iterator[str]:
    """Yields the names of the checks that a cell calls."""
    for statement in _statements(cell):
        match statement:
            case ast.Expr(ast.Call(ast.Attribute(ast.Name("check"), name))):
                yield name


def _is_needed(statement: ast.stmt) -> bool:
    """Returns whether a statement is an import, a definition, a check or a constant."""
    match statement:
        case ast.Import() | ast.ImportFrom() | ast.FunctionDef() | ast.ClassDef():
            return True
        case ast.Expr(ast.Call(ast.Name("speak") | ast.Attribute(ast.Name("check")))):
            return True
        case ast.Assign() | ast.AnnAssign():
            calls = [node.func for node in ast.walk(statement) if isinstance(node, ast.Call)]
            return all(_root(call) in MODULES for call in calls)
    return False


def _root(node: ast.expr) -> str:
    """Returns the first name of a dotted one, such as ``np`` of ``np.linspace``."""
    while isinstance(node, ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""
