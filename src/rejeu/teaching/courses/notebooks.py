r'''Makes the exercises and solutions of the courses, in each language, from one source.

A source is ``sources/NUMBER_name.md``, a notebook in jupytext's Markdown format. Code occurs once. What differs is marked:

``<!-- #region lang="en" -->`` ... ``<!-- #endregion -->``
    A cell of text in one language. The same text in French follows in a cell with ``lang="fr"``.
``<!-- #region lang="en" role="answer" -->``
    The answer to a question. Exercises have a cell for the student's answer in its place.
:literal:`\`\`\`python only="solution"`, ``only="exercise"``
    A cell of one version.
``# [en] Sample a batch.``, ``plt.title("Returns")  # [en]``
    A line of code of one language. The mark is removed, a comment behind it remains.
``# SOLUTION`` ... ``# END``
    What the student writes. In the exercise the comments right below ``# SOLUTION`` remain, and ``...`` follows them, or
    what stands behind ``# SOLUTION``: ``# SOLUTION loss = ...``. In the solution those comments are removed.
``{language}``
    In a code cell: the language, ``en`` or ``fr``. A source uses it once: ``speak("{language}")``.

Code of a function whose text is in two languages and whose body the student writes::

    def epsilon(step, n_steps):
        """Returns the probability of a random action."""  # [en]
        """Renvoie la probabilité d'une action aléatoire."""  # [fr]
        # SOLUTION
        # [en] TODO: decrease it linearly from 1 to 0.05 over n_steps steps; then it stays.
        # [fr] À FAIRE : la faire décroître linéairement de 1 à 0,05 en n_steps pas ; ensuite elle reste constante.
        return max(1 - 0.95 * step / n_steps, 0.05)
        # END

    check.epsilon(epsilon)
'''

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from types import ModuleType
from typing import Literal, get_args

from rejeu.core.atomic import make_folder
from rejeu.core.errors import requires
from rejeu.core.language import LANGUAGES, Language
from rejeu.core.types import JsonObject

Version = Literal["exercise", "solution"]

ANSWER: dict[Language, str] = {"en": "*Your answer:* ...", "fr": "*Votre réponse :* ..."}
"""Text of an exercise in place of an answer."""
SPEED = "REJEU_COURSE_SPEED"
"""Environment variable that divides the numbers of steps, for a quick look at a whole notebook."""
KERNEL = {"display_name": "Python 3", "language": "python", "name": "python3"}
OPTIONS: dict[str, tuple[str, ...]] = {"lang": LANGUAGES, "only": get_args(Version), "role": ("answer",)}
"""Options of a cell, and their values."""

OF_LANGUAGE = re.compile(r"(?P<before>.*?)# \[(?P<language>\w\w)\](?: (?P<after>.*))?")
BEGIN = re.compile(r"(?P<indent> *)# SOLUTION(?: (?P<left>.+))?")
END = re.compile(r" *# END")
CODE_OR_MATH = re.compile(r"(`[^`]*`|\$\$.*?\$\$|\$[^$]*\$)", re.DOTALL)


def steps(n: int) -> int:
    """Returns a number of steps, divided by the environment variable ``REJEU_COURSE_SPEED`` if it is set.

    >>> steps(50_000)
    50000
    """
    return max(1, round(minutes(n)))


def minutes(n: float) -> float:
    """Returns minutes of training, divided as :func:`steps` divides.

    >>> minutes(0.5)
    0.5
    """
    return n / float(os.environ.get(SPEED) or 1)


def sources() -> list[Traversable]:
    """Returns the sources of the courses, in their order."""
    folder = resources.files("rejeu.teaching.courses") / "sources"
    return sorted((file for file in folder.iterdir() if file.name.endswith(".md")), key=lambda file: file.name)


def write(language: Language, folder: Path) -> Iterator[tuple[Path, bool]]:
    """Writes all courses, the solutions into the folder ``solutions``, and yields each path and whether it was written.

    Each is written as a notebook (.ipynb) and as a text notebook (.py). Files that exist are not changed.

    Raises:
        MissingExtra: if jupytext is not installed.
        OSError: if a file cannot be written.
    """
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(f"{folder} is a file, expected a folder")
    folders: dict[Version, Path] = {"exercise": folder, "solution": folder / "solutions"}
    for source in sources():
        content = source.read_text(encoding="utf-8")
        for version, parent in folders.items():
            document = notebook(content, language, version)
            make_folder(parent)
            for ending, form in ((".py", "py:percent"), (".ipynb", "ipynb")):
                path = parent / f"{source.name.removesuffix('.md')}{ending}"
                yield path, _write_new(path, jupytext().writes(document, form))


def jupytext() -> ModuleType:
    """Returns jupytext, which reads and writes notebooks as text.

    Raises:
        MissingExtra: if it is not installed.
    """
    with requires("notebooks of the courses", "jupytext", "course"):
        import jupytext
    return jupytext


def notebook(source: str, language: Language, version: Version) -> JsonObject:
    r"""Returns a version of a source in one language, as a notebook of ``nbformat``.

    Raises:
        ValueError: if the source has an invalid mark; the message has the line.

    >>> source = "```python\n# SOLUTION x = ...\nx = 1\n# END\nprint(x)\n```"
    >>> print(notebook(source, "en", "exercise").cells[0].source)
    x = ...
    print(x)
    """
    result = jupytext().reads(source, "md")
    result.metadata = {"kernelspec": KERNEL, "jupytext": {"cell_metadata_filter": "-all"}}
    included_cells = []
    for cell in result.cells:
        options = {name: value for name, value in cell.metadata.items() if name != "lines_to_next_cell"}
        for name, value in options.items():
            if value not in OPTIONS.get(name, ()):
                raise ValueError(f'{name}="{value}" must be one of {OPTIONS}, in the cell: {cell.source[:60]!r}')
        if options.get("lang", language) != language or options.get("only", version) != version:
            continue
        if cell.cell_type == "code":
            cell.source = "\n".join(_code(cell.source.splitlines(), language, version)).replace("{language}", language)
        elif options.get("role") == "answer" and version == "exercise":
            cell.source = ANSWER[language]
        elif language == "fr":
            cell.source = _with_french_spaces(cell.source)
        cell.metadata = {}
        included_cells.append(cell)
    result.cells = included_cells
    return result


def _code(lines: list[str], language: Language, version: Version) -> Iterator[str]:
    """Yields the lines of a code cell in one language and version."""
    where: Literal["outside", "hints", "inside"] = "outside"
    for whole in lines:
        begin, end = BEGIN.fullmatch(whole), END.fullmatch(whole)
        if (begin and where != "outside") or (end and where == "outside"):
            raise ValueError(f"{whole.strip()!r} is not expected here, after {lines[0]!r}")
        if begin is not None:
            where, placeholder = "hints", begin["indent"] + (begin["left"] or "...")
            continue
        if where == "hints" and not whole.lstrip().startswith("# ["):
            where = "inside"
            if version == "exercise":
                yield placeholder
        if end is not None:
            where = "outside"
            continue
        line = _in_language(whole, language)
        is_included = where == "outside" or (where == "hints") == (version == "exercise")
        if line is not None and is_included:
            yield line
    if where != "outside":
        raise ValueError(f"a cell has # SOLUTION without # END: {lines[0]!r}")


def _in_language(line: str, language: Language) -> str | None:
    """Returns a line without its mark, or None if it is of another language.

    >>> _in_language('plt.title("Returns")  # [en]', "en"), _in_language("# [fr] Tirer un lot.", "en")
    ('plt.title("Returns")', None)
    """
    match = OF_LANGUAGE.fullmatch(line)
    if match is None:
        return line
    if match["language"] not in LANGUAGES:
        raise ValueError(f"[{match['language']}] must be one of {', '.join(LANGUAGES)}: {line.strip()!r}")
    if match["language"] != language:
        return None
    return f"{match['before']}# {match['after']}" if match["after"] else match["before"].rstrip()


def _with_french_spaces(text: str) -> str:
    r"""Returns a text with no-break spaces where French has them, except in code and formulas.

    >>> _with_french_spaces("Pourquoi ? `a ? b`")
    'Pourquoi\xa0? `a ? b`'
    """
    parts = CODE_OR_MATH.split(text)
    parts[::2] = [re.sub(r" (?=[:;?!»%](?![-\w]))|(?<=«) ", "\N{NO-BREAK SPACE}", prose) for prose in parts[::2]]
    return "".join(parts)


def _write_new(path: Path, content: str) -> bool:
    """Writes a file unless the path exists, and returns whether it did."""
    try:
        with path.open("x", encoding="utf-8", newline="\n") as file:
            file.write(content)
    except FileExistsError:
        return False
    return True
