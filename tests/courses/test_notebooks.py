"""Sources of the courses: both languages and versions, and what a folder of notebooks holds."""

import json

import pytest

from rejeu import courses
from rejeu.cli import main
from rejeu.courses import notebooks

SOURCE = """
# %% [markdown] lang="en"
# Why is it so?

# %% [markdown] lang="fr"
# Pourquoi ? `a ? b` et $a : b$

# %% [markdown] lang="en" role="answer"
# Because.

# %%
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

# %% only="solution"
print("solution")
"""


def body(language, version):
    return courses.text(SOURCE, language, version).removeprefix(notebooks.HEADER)


def test_an_exercise_has_what_is_to_do_in_place_of_the_solution():
    assert (
        body("en", "exercise")
        == """
# %% [markdown]
# Why is it so?

# %% [markdown]
# *Your answer:* ...

# %%
x = 1
def f():
    # TODO: think.
    y = ...
print("en")
"""
    )


def test_a_solution_has_the_code_and_the_answers():
    assert body("fr", "solution") == (
        "\n# %% [markdown]\n# Pourquoi\N{NO-BREAK SPACE}? `a ? b` et $a : b$\n\n"
        '# %%\nx = 2\ndef f():\n    y = {"a": 1}\n    # because it is\n    return y\nprint("fr")\n\n'
        '# %%\nprint("solution")\n'
    )


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("# %%\n# SOLUTION\nx", "line 1: a cell has # SOLUTION without # END"),
        ("# %%\n\n\n# END", "'# END' is not expected here"),
        ("# %%\n# SOLUTION\nx = 1\n# SOLUTION", "'# SOLUTION' is not expected here"),
        ('# %% [markdown] lang="de"', 'line 1: .* must be like # %% .markdown. lang="en"'),
        ("# %%\nx = 1  # [de]", r"line 2: \[de\] must be one of en, fr"),
    ],
)
def test_an_invalid_mark_is_reported_with_its_line(source, message):
    with pytest.raises(ValueError, match=message):
        courses.text(source, "en", "exercise")


@pytest.mark.parametrize("source", courses.sources(), ids=lambda source: source.name)
def test_each_source_has_as_many_cells_in_each_language(source):
    cells = notebooks.cells(source.read_text(encoding="utf-8"))
    kinds = [
        [(c.is_markdown, c.options.get("role")) for c in cells if c.options.get("lang") == x] for x in ("en", "fr")
    ]
    assert kinds[0] == kinds[1]
    assert not [cell.line for cell in cells if cell.is_markdown and "lang" not in cell.options]


@pytest.mark.parametrize("source", courses.sources(), ids=lambda source: source.name)
def test_solutions_of_both_languages_have_the_same_code(source):
    text = source.read_text(encoding="utf-8")
    for version in ("exercise", "solution"):
        found = [list(lines(courses.text(text, language, version))) for language in courses.LANGUAGES]
        assert len(found[0]) == len(found[1])


def lines(percent):
    """Yields the code of the cells without comments."""
    for cell in notebooks.cells(percent):
        if not cell.is_markdown:
            yield from (line for line in cell.lines if not line.lstrip().startswith("#"))


def test_course_writes_notebooks_and_never_changes_a_file(tmp_path, capsys):
    folder = tmp_path / "my course"
    assert main(["course", "fr", str(folder)]) == 0
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.*"))
    stems = [source.name.removesuffix(".py") for source in courses.sources()]
    assert {f"{stem}.py" for stem in stems} | {f"solutions/{stem}.py" for stem in stems} <= set(names)
    mine = folder / f"{stems[0]}.py"
    mine.write_text("mine", encoding="utf-8")
    capsys.readouterr()
    assert main(["course", "fr", str(folder)]) == 0
    out = capsys.readouterr().out
    assert mine.read_text(encoding="utf-8") == "mine"
    assert f"{mine} exists and was not changed" in out
    assert len(out.splitlines()) == len(names)


def test_course_names_written_and_kept_files_as_json(tmp_path, capsys):
    assert main(["course", "en", str(tmp_path), "--json"]) == 0
    written = json.loads(capsys.readouterr().out)
    assert not written["kept"]
    assert main(["course", "en", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"written": [], "kept": written["written"]}


def test_notebooks_have_the_cells_of_the_text():
    pytest.importorskip("jupytext")
    cells = json.loads(notebooks.notebook(courses.text(SOURCE, "en", "solution")))["cells"]
    assert [cell["cell_type"] for cell in cells] == ["markdown", "markdown", "code", "code"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["de", "x"], "LANGUAGE 'de' must be one of en, fr"),
        (["en"], "rejeu course needs FOLDER"),
        (["en", __file__], "is a file, expected a folder"),
    ],
)
def test_invalid_arguments_give_one_line(arguments, message, capsys):
    assert main(["course", *arguments]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert len(err.splitlines()) == 1
