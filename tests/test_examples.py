"""The scripts in ``examples/`` run. Only their length is cut (the fixture ``short``)."""

import runpy
import sys
from pathlib import Path

import pytest

from tests.tiers import exhaustive, only

FOLDER = Path(__file__).parents[1] / "examples"
TESTED_ELSEWHERE = ("awac", "fastapi_service", "ros2_node")
"""``awac.py`` registers an algorithm (``test_own_algorithm``); two need other systems (``export/test_deployment``)."""
EXAMPLES = sorted(path for path in FOLDER.glob("*.py") if path.stem not in TESTED_ELSEWHERE)
BY_DEFAULT = [FOLDER / f"{name}.py" for name in ("cartpole", "dqn_from_parts", "own_callback", "own_network")]
ARGUMENTS = {"many_agents": ["--agents", "3", "--steps", "2000"]}
"""Arguments that shorten an example which does not call ``learn``."""


@pytest.mark.parametrize("script", only(BY_DEFAULT, EXAMPLES), ids=lambda script: script.stem)
def test_example_runs(script, short, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(script), *ARGUMENTS.get(script.stem, [])])
    if script.stem == "parking":
        pytest.importorskip("highway_env")
    runpy.run_path(str(script), run_name="__main__")


@exhaustive
def test_the_agents_of_the_example_differ_and_their_returns_are_counted(monkeypatch, capsys):
    script = FOLDER / "many_agents.py"
    monkeypatch.setattr(sys, "argv", [str(script), "--agents", "4", "--steps", "2000"])
    names = runpy.run_path(str(script), run_name="__main__")
    lines = capsys.readouterr().out.splitlines()
    assert "mean return of 4 greedy policies" in lines[10]
    histogram = [int(line.split()[3]) for line in lines if " to " in line]
    assert (len(histogram), sum(histogram)) == (10, 4)
    one, two = (names["begin"](seed)[0].network.head.weight for seed in (0, 1))
    assert (one != two).any()


def test_examples_are_found():
    assert {*BY_DEFAULT, FOLDER / "parking.py", FOLDER / "resume.py"} <= {*EXAMPLES}
