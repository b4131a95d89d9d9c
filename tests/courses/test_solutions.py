"""Every solution runs to its end, and an exercise that is not filled in stops with one line."""

import ast
import os
import subprocess
import sys

import jax
import pytest

from rejeu import courses

NAMES = [source.name for source in courses.sources()]


def run(name, language, version, folder, speed):
    """Runs a text notebook as a script, without a display, and returns what it printed and its errors."""
    source = next(source for source in courses.sources() if source.name == name)
    script = folder / name
    script.write_text(courses.text(source.read_text(encoding="utf-8"), language, version), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, script.name],
        cwd=folder,
        env=without_display() | {"MPLBACKEND": "agg", "PYTHONIOENCODING": "utf-8", "REJEU_COURSE_SPEED": str(speed)},
        capture_output=True,
        encoding="utf-8",
        timeout=1800,
        check=False,
    )
    return done.stdout, done.stderr


def without_display():
    """Returns the environment variables without a display: a game would wait for a key."""
    hidden = {"DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"}
    return {key: value for key, value in os.environ.items() if key not in hidden}


# By default exercise notebooks run for course 1 in French, which has the same code as English. Solutions train, so they run in
# the exhaustive tests; by default their functions are checked.
FRENCH_FIRST = pytest.mark.parametrize("language", [pytest.param("en", marks=pytest.mark.exhaustive), "fr"])
COURSE_1_FIRST = pytest.mark.parametrize(
    "name", [NAMES[0], *(pytest.param(name, marks=pytest.mark.exhaustive) for name in NAMES[1:])]
)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("language", courses.LANGUAGES)
def test_a_solution_passes_all_its_checks_in_a_shortened_run(name, language, tmp_path):
    out, err = run(name, language, "solution", tmp_path, 100)
    assert "Traceback" not in err, err
    assert "OK - " in out
    assert not [line for line in out.splitlines() if line.startswith(("Not yet", "Pas encore"))]


@pytest.mark.parametrize("name", NAMES)
def test_the_functions_of_a_solution_pass_their_checks(name, capsys):
    pytest.importorskip("highway_env")
    source = next(source for source in courses.sources() if source.name == name)
    tree = ast.parse(courses.text(source.read_text(encoding="utf-8"), "fr", "solution"))
    tree.body = list(without_training(tree.body))
    with jax.numpy_rank_promotion("allow"):
        exec(compile(tree, name, "exec"), {"__name__": "__main__"})
    out = capsys.readouterr().out.splitlines()
    assert len(out) >= 8
    assert all(line.startswith("OK - ") for line in out)


def without_training(statements):
    """Yields imports, definitions, constants, and the checks of what was defined."""
    defined = set()
    for node in statements:
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                defined.add(name)
            case ast.Assign(targets=[ast.Name(id=name)], value=ast.BinOp(ast.Constant(), _, ast.Constant())):
                defined.add(name)
            case ast.Import() | ast.ImportFrom() | ast.Expr(ast.Call(ast.Name("speak"))):
                pass
            case ast.Expr(ast.Call(ast.Attribute(ast.Name("check")), arguments)) if all(
                isinstance(argument, ast.Name) and argument.id in defined for argument in arguments
            ):
                pass
            case _:
                continue
        yield node


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", NAMES)
def test_a_solution_runs_in_full(name, tmp_path):
    _, err = run(name, "en", "solution", tmp_path, 1)
    assert "Traceback" not in err, err


@COURSE_1_FIRST
@FRENCH_FIRST
def test_an_exercise_that_is_not_filled_in_stops_in_a_notebook_with_one_line(name, language):
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    source = next(source for source in courses.sources() if source.name == name)
    made = courses.notebook(courses.text(source.read_text(encoding="utf-8"), language, "exercise"))
    notebook = nbformat.reads(made, as_version=4)
    with pytest.raises(nbclient.exceptions.CellExecutionError):
        nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3").execute(env=without_display())
    errors = [o for cell in notebook.cells for o in cell.get("outputs", ()) if o["output_type"] == "error"]
    assert [error["ename"] for error in errors] == ["NotReady"]
    assert len("\n".join(errors[0]["traceback"]).splitlines()) == 1
    printed = "".join(o.get("text", "") for cell in notebook.cells for o in cell.get("outputs", ()))
    assert {"en": "Not yet", "fr": "Pas encore"}[language] in printed
