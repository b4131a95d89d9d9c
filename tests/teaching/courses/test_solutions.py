"""Every solution runs and passes its checks, and an exercise that is not filled in says in one line what is missing."""

import os
import subprocess
import sys

import pytest

from rejeu.lab.cli import main
from rejeu.teaching import courses
from rejeu.teaching.courses import grading, notebooks
from tests.teaching.courses.solutions import text_of
from tests.tiers import only

SOURCES = courses.sources()
EACH = pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.name)
EACH_LANGUAGE = pytest.mark.parametrize("language", courses.LANGUAGES)


def made(source, language, version):
    return courses.notebook(source.read_text(encoding="utf-8"), language, version)


def without_display():
    """Returns the environment variables without a display: a game would wait for a key."""
    hidden = {"DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"}
    return {key: value for key, value in os.environ.items() if key not in hidden}


@pytest.mark.exhaustive
@EACH
def test_a_solution_runs_in_full_and_passes_all_its_checks(source, tmp_path):
    (tmp_path / "notebook.py").write_text(text_of(source, "en"), encoding="utf-8")
    environ = without_display() | {"MPLBACKEND": "agg", "PYTHONIOENCODING": "utf-8"}
    command = [sys.executable, "notebook.py"]
    done = subprocess.run(command, cwd=tmp_path, env=environ, capture_output=True, encoding="utf-8", timeout=1800)
    assert "Traceback" not in done.stderr, done.stderr
    assert "OK - " in done.stdout
    assert not [line for line in done.stdout.splitlines() if line.startswith("Not yet")]


@pytest.mark.parametrize("source", only(SOURCES[-1:], SOURCES), ids=lambda source: source.name)
def test_a_solution_is_graded_as_right_and_an_exercise_as_not_yet(source, tmp_path, capsys):
    pytest.importorskip("highway_env")
    for version in ("solution", "exercise"):
        for ending in (".ipynb", ".py"):
            text = notebooks.jupytext().writes(made(source, "fr", version), ending[1:])
            (tmp_path / f"{version}{ending}").write_text(text, encoding="utf-8")
    assert main(["course", "grade", str(tmp_path / "solution.ipynb"), str(tmp_path / "exercise.py")]) == 0
    solution, exercise, *rest = capsys.readouterr().out.splitlines()
    n = int(solution.split(" sur ")[1])
    assert solution == f"{tmp_path / 'solution.ipynb'} : {n} réussies sur {n}"
    assert exercise == f"{tmp_path / 'exercise.py'} : 0 réussies sur {n}"
    assert len(rest) == n
    assert len(set(rest)) >= n - 2


def test_a_notebook_that_does_not_end_or_is_none_is_not_graded(tmp_path, capsys):
    endless, other = tmp_path / "endless.py", tmp_path / "other.ipynb"
    endless.write_text(
        "def f():\n    while True: pass\n\ncheck.f(f)\nwhile True: pass\n\nclass A:\n    while True: pass"
    )
    other.write_text("{}")
    assert "took longer than 1 second" in grading.grade(endless, 1).error
    assert main(["course", "grade", str(other)]) == 2
    assert len(capsys.readouterr().out.splitlines()) == 1


@pytest.mark.exhaustive
@EACH
@EACH_LANGUAGE
def test_a_notebook_that_is_not_filled_in_has_one_line_for_each_cell_that_needs_an_answer(source, language):
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    notebook = made(source, language, "exercise")
    client = nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3", allow_errors=True)
    client.execute(env=without_display() | {"REJEU_COURSE_SPEED": "100"})
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    errors = [output for output in outputs if output["output_type"] == "error"]
    assert errors
    assert {error["ename"] for error in errors} == {"NotReady"}
    assert {len("\n".join(error["traceback"]).splitlines()) for error in errors} == {1}
    assert {"en": "Not yet", "fr": "Pas encore"}[language] in "".join(output.get("text", "") for output in outputs)
