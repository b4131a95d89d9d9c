r'''Makes the exercises and solutions of the courses, in each language, from one source.

A source is ``sources/NUMBER_name.py``, a text notebook in jupytext's percent format. Code occurs once. What differs is
marked:

``# %% [markdown] lang="en"``
    A cell of one language. The same text in French follows in a cell with ``lang="fr"``.
``# %% [markdown] lang="en" role="answer"``
    The answer to a question. Exercises have a cell for the student's answer in its place.
``# %% only="solution"``, ``# %% only="exercise"``
    A cell of one version.
``# [en] Sample a batch.``, ``plt.title("Returns")  # [en]``
    A line of one language. The mark is removed, a comment behind it remains.
``# SOLUTION`` ... ``# END``
    What the student writes. In the exercise the comments right below ``# SOLUTION`` remain, and ``...`` follows them, or
    what stands behind ``# SOLUTION``: ``# SOLUTION loss = ...``. In the solution those comments are removed.
``{language}``
    In a code cell: the language, ``en`` or ``fr``. A source uses it once: ``speak("{language}")``.

An example::

    # %% [markdown] lang="en"
    # With probability $\varepsilon$ the action is random.

    # %% [markdown] lang="fr"
    # Avec une probabilité $\varepsilon$, l'action est aléatoire.

    # %%
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
from typing import Literal, NamedTuple, get_args

from rejeu.io.atomic import make_folder

Language = Literal["en", "fr"]
Version = Literal["exercise", "solution"]
LANGUAGES: tuple[Language, ...] = get_args(Language)

ANSWER: dict[Language, str] = {"en": "# *Your answer:* ...", "fr": "# *Votre réponse :* ..."}
"""What stands in an exercise in place of an answer."""
SPEED = "REJEU_COURSE_SPEED"
"""Environment variable that divides the numbers of steps, for a quick look at a whole notebook."""
HEADER = """\
# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---
"""

CELL = re.compile(r'# %%(?P<markdown> \[markdown\])?(?P<options>(?: \w+="\w+")*)')
OF_LANGUAGE = re.compile(r"(?P<before>.*?)# \[(?P<language>\w\w)\](?: (?P<after>.*))?")
BEGIN = re.compile(r"(?P<indent> *)# SOLUTION(?: (?P<left>.+))?")
END = re.compile(r" *# END")
CODE_OR_MATH = re.compile(r"(`[^`]*`|\$\$.*?\$\$|\$[^$]*\$)", re.DOTALL)


class Cell(NamedTuple):
    """A cell of a source."""

    line: int
    """Number of its first line."""
    is_markdown: bool
    options: dict[str, str]
    """``lang``, ``only`` and ``role``."""
    lines: list[str]
    """Without the header and without blank lines at both ends."""


def steps(n: int) -> int:
    """Returns a number of steps, divided by the environment variable ``REJEU_COURSE_SPEED`` if it is set.

    >>> steps(50_000)
    50000
    """
    return max(1, round(n / float(os.environ.get(SPEED) or 1)))


def minutes(n: float) -> float:
    """Returns minutes of training, divided as :func:`steps` divides.

    >>> minutes(0.5)
    0.5
    """
    return n / float(os.environ.get(SPEED) or 1)


def sources() -> list[Traversable]:
    """Returns the sources of the courses, in their order."""
    folder = resources.files("rejeu.courses") / "sources"
    return sorted((file for file in folder.iterdir() if file.name.endswith(".py")), key=lambda file: file.name)


def write(language: Language, folder: Path) -> Iterator[tuple[Path, bool]]:
    """Writes all courses, the solutions into the folder ``solutions``, and yields each path and whether it was written.

    Files that exist are not changed. Notebooks (.ipynb) are written if jupytext is installed, text notebooks (.py) always.

    Raises:
        OSError: if a file cannot be written.
    """
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(f"{folder} is a file, expected a folder")
    for source in sources():
        stem = source.name.removesuffix(".py")
        folders: dict[Version, Path] = {"exercise": folder, "solution": folder / "solutions"}
        for version, parent in folders.items():
            written = text(source.read_text(encoding="utf-8"), language, version)
            make_folder(parent)
            for path, content in ((parent / f"{stem}.py", written), (parent / f"{stem}.ipynb", notebook(written))):
                if content is not None:
                    yield path, _write_new(path, content)


def notebook(percent: str) -> str | None:
    """Returns a text notebook in the format of Jupyter, or None if jupytext is not installed."""
    try:
        import jupytext
    except ImportError:
        return None
    return jupytext.writes(jupytext.reads(percent, fmt="py:percent"), fmt="ipynb")


def text(source: str, language: Language, version: Version) -> str:
    r"""Returns a version of a source in one language, as a text notebook.

    Raises:
        ValueError: if the source has an invalid mark; the message has its line.

    >>> print(text('# %%\n# SOLUTION x = ...\nx = 1\n# END\nprint(x)', "en", "exercise").split("# ---\n")[2].strip())
    # %%
    x = ...
    print(x)
    """
    parts = [HEADER]
    for cell in cells(source):
        if cell.options.get("lang", language) != language or cell.options.get("only", version) != version:
            continue
        if not cell.is_markdown:
            code = [line.replace("{language}", language) for line in _code(cell, language, version)]
            parts.append("\n".join(["# %%", *code, ""]))
        elif cell.options.get("role") == "answer" and version == "exercise":
            parts.append("\n".join(["# %% [markdown]", ANSWER[language], ""]))
        else:
            lines = cell.lines if language != "fr" else [_with_french_spaces(line) for line in cell.lines]
            parts.append("\n".join(["# %% [markdown]", *lines, ""]))
    return "\n".join(parts)


def cells(source: str) -> list[Cell]:
    """Returns the cells of a source; what comes before the first one is left out.

    Raises:
        ValueError: if the first line of a cell is invalid.
    """
    result: list[Cell] = []
    for number, line in enumerate(source.splitlines(), start=1):
        if line.startswith("# %%"):
            match = CELL.fullmatch(line)
            options = dict(re.findall(r'(\w+)="(\w+)"', match["options"])) if match else {}
            allowed = {"lang": LANGUAGES, "only": get_args(Version), "role": ("answer",)}
            if match is None or any(value not in allowed.get(key, ()) for key, value in options.items()):
                raise ValueError(f'line {number}: {line!r} must be like # %% [markdown] lang="en" role="answer"')
            result.append(Cell(number, match["markdown"] is not None, options, []))
        elif result:
            result[-1].lines.append(line)
    return [cell._replace(lines="\n".join(cell.lines).strip("\n").splitlines()) for cell in result]


def _code(cell: Cell, language: Language, version: Version) -> Iterator[str]:
    """Yields the lines of a code cell in one language and version."""
    where: Literal["outside", "hints", "inside"] = "outside"
    for number, whole in enumerate(cell.lines, start=cell.line + 1):
        begin, end = BEGIN.fullmatch(whole), END.fullmatch(whole)
        if (begin and where != "outside") or (end and where == "outside"):
            raise ValueError(f"line {number}: {whole.strip()!r} is not expected here")
        if begin is not None:
            where, left = "hints", begin["indent"] + (begin["left"] or "...")
            continue
        if where == "hints" and not whole.lstrip().startswith("# ["):
            where = "inside"
            if version == "exercise":
                yield left
        if end is not None:
            where = "outside"
            continue
        line = _in_language(whole, number, language)
        wanted = where == "outside" or (where == "hints") == (version == "exercise")
        if line is not None and wanted:
            yield line
    if where != "outside":
        raise ValueError(f"line {cell.line}: a cell has # SOLUTION without # END")


def _in_language(line: str, number: int, language: Language) -> str | None:
    """Returns a line without its mark, or None if it is of another language.

    >>> _in_language('plt.title("Returns")  # [en]', 1, "en"), _in_language("# [fr] Tirer un lot.", 1, "en")
    ('plt.title("Returns")', None)
    """
    match = OF_LANGUAGE.fullmatch(line)
    if match is None:
        return line
    if match["language"] not in LANGUAGES:
        raise ValueError(f"line {number}: [{match['language']}] must be one of {', '.join(LANGUAGES)}")
    if match["language"] != language:
        return None
    return f"{match['before']}# {match['after']}" if match["after"] else match["before"].rstrip()


def _with_french_spaces(line: str) -> str:
    r"""Returns a line of text with no-break spaces where French has them, except in code and formulas.

    >>> _with_french_spaces("Pourquoi ? `a ? b`")
    'Pourquoi\xa0? `a ? b`'
    """
    parts = CODE_OR_MATH.split(line)
    parts[::2] = [re.sub(r" (?=[:;?!»%](?![-\w]))|(?<=«) ", "\N{NO-BREAK SPACE}", part) for part in parts[::2]]
    return "".join(parts)


def _write_new(path: Path, content: str) -> bool:
    """Writes a file unless the path exists, and returns whether it did."""
    try:
        with path.open("x", encoding="utf-8", newline="\n") as file:
            file.write(content)
    except FileExistsError:
        return False
    return True
