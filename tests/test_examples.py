"""The scripts in ``examples/`` run. Only their length is cut (the fixture ``short``)."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "examples"
EXAMPLES = sorted(path for path in FOLDER.glob("*.py") if path.stem != "awac")
"""``awac.py`` registers an algorithm; ``test_own_algorithm`` tests it."""


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda script: script.stem)
def test_example_runs(script, short, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if script.stem == "parking":
        pytest.importorskip("highway_env")
    runpy.run_path(str(script), run_name="__main__")


def test_examples_are_found():
    assert {"cartpole", "parking", "resume"} <= {script.stem for script in EXAMPLES}
