"""Sources of the courses: both languages and versions, and what a folder of notebooks holds."""

import ast
import json
import subprocess
import sys

import pytest

from rejeu.lab.cli import main
from rejeu.teaching import courses
from rejeu.teaching.courses import notebooks
from tests.teaching.courses.solutions import text_of

SOURCE = """\
<!-- #region lang="en" -->
Why is it so?
<!-- #endregion -->

<!-- #region lang="fr" -->
Pourquoi ? `a ? b` et $a : b$
<!-- #endregion -->

<!-- #region lang="en" role="answer" -->
Because.
<!-- #endregion -->

```python
x = 1  # [en]
x = 2  # [fr]
def f():
    # SOLUTION y = ...
    # [en] TODO: think.
    # [fr] À FAIRE : penser.
    y = {"a": 1}
    # because it is
    return y
    # END
print("{language}")
```

```python only="solution"
print("solution")
```
"""


def cells(language, version):
    return [(cell.cell_type, cell.source) for cell in courses.notebook(SOURCE, language, version).cells]


def test_an_exercise_has_what_is_to_do_in_place_of_the_solution():
    assert cells("en", "exercise") == [
        ("markdown", "Why is it so?"),
        ("markdown", "*Your answer:* ..."),
        ("code", 'x = 1\ndef f():\n    # TODO: think.\n    y = ...\nprint("en")'),
    ]


def test_a_solution_has_the_code_and_the_answers():
    assert cells("fr", "solution") == [
        ("markdown", "Pourquoi\N{NO-BREAK SPACE}? `a ? b` et $a : b$"),
        ("code", 'x = 2\ndef f():\n    y = {"a": 1}\n    # because it is\n    return y\nprint("fr")'),
        ("code", 'print("solution")'),
    ]
    assert ("markdown", "Because.") in cells("en", "solution")


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("```python\n# SOLUTION\nx\n```", "a cell has # SOLUTION without # END"),
        ("```python\n\n\n# END\n```", "'# END' is not expected here"),
        ("```python\n# SOLUTION\nx = 1\n# SOLUTION\n```", "'# SOLUTION' is not expected here"),
        ('<!-- #region lang="de" -->\nWarum?\n<!-- #endregion -->', 'lang="de" must be one of'),
        ("```python\nx = 1  # [de]\n```", r"\[de\] must be one of en, fr"),
    ],
)
def test_an_invalid_mark_is_reported(source, message):
    with pytest.raises(ValueError, match=message):
        courses.notebook(source, "en", "exercise")


@pytest.mark.parametrize("source", courses.sources(), ids=lambda source: source.name)
def test_each_source_has_the_same_cells_and_code_in_each_language(source):
    text = source.read_text(encoding="utf-8")
    marked = [cell.metadata for cell in notebooks.jupytext().reads(text, "md").cells if cell.cell_type == "markdown"]
    languages = [[cell.get("role") for cell in marked if cell.get("lang") == x] for x in courses.LANGUAGES]
    assert languages[0] == languages[1]
    assert len(marked) == 2 * len(languages[0])
    for version in ("exercise", "solution"):
        english, french = (courses.notebook(text, language, version).cells for language in courses.LANGUAGES)
        for one, other in zip(english, french, strict=True):
            if one.cell_type == "code":
                assert shape(one.source) == shape(other.source)


def shape(code):
    """Returns the kinds of the statements of code, and the names that they use."""
    tree = ast.parse(code)
    names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    return [type(node).__name__ for node in ast.walk(tree) if isinstance(node, ast.stmt)], names


@pytest.mark.parametrize("source", courses.sources(), ids=lambda source: source.name)
def test_the_code_of_a_solution_has_no_unknown_or_unused_names(source, tmp_path):
    for language in courses.LANGUAGES:
        made = text_of(source, language)
        (tmp_path / f"{language}.py").write_text(made, encoding="utf-8")
    command = [sys.executable, "-m", "ruff", "check", "--isolated", "--select", "F,E9,B", "--ignore", "F401,F811,B018"]
    done = subprocess.run([*command, tmp_path], capture_output=True, text=True, check=False)
    assert not done.returncode, done.stdout + done.stderr


def test_course_writes_notebooks_and_never_changes_a_file(tmp_path, capsys):
    folder = tmp_path / "my course"
    assert main(["course", "fr", str(folder), "--json"]) == 0
    written = json.loads(capsys.readouterr().out)
    assert not written["kept"]
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.*"))
    stems = [source.name.removesuffix(".md") for source in courses.sources()]
    files = {f"{stem}{ending}" for stem in stems for ending in (".py", ".ipynb")}
    assert {*names} == files | {f"solutions/{name}" for name in files}
    mine = folder / f"{stems[0]}.py"
    mine.write_text("mine", encoding="utf-8")
    assert main(["course", "fr", str(folder), "--json"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out) == {"written": [], "kept": written["written"]}
    assert mine.read_text(encoding="utf-8") == "mine"
    assert f"{mine} exists and was not changed" in printed.err
    assert len(printed.err.splitlines()) == len(names)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["de", "x"], "LANGUAGE 'de' must be one of en, fr"),
        (["en"], "rejeu course needs FOLDER"),
        (["en", "x", "y"], "needs one FOLDER"),
        (["en", __file__], "is a file, expected a folder"),
        (["grade", "missing.ipynb"], "missing.ipynb"),
    ],
)
def test_invalid_arguments_give_one_line(arguments, message, capsys):
    assert main(["course", *arguments]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert len(err.splitlines()) == 1
