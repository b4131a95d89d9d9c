"""The scripts in ``examples/`` run. Only their length is cut (the fixture ``short``)."""

import runpy
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.agents import presets
from tests.tiers import exhaustive, only

FOLDER = Path(__file__).parents[1] / "examples"
TESTED_ELSEWHERE = ("ant_maze", "awac", "fastapi_service", "ros2_node")
"""``ant_maze.py`` registers environments (below), ``awac.py`` an algorithm (``test_own_algorithm``); two need other systems
(``export/test_deployment``)."""
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


@exhaustive
def test_the_ant_of_the_example_sees_from_where_it_faces_and_stands_or_walks_as_it_is_told(
    tmp_path, monkeypatch, request
):
    pytest.importorskip("mujoco")
    pytest.importorskip("gymnasium_robotics")
    monkeypatch.setattr(presets, "registered", {})
    request.addfinalizer(lambda: [gym.registry.pop(env_id) for env_id in ("AntWalk-v0", "AntMazeDirected-v0")])
    example = runpy.run_path(str(FOLDER / "ant_maze.py"))
    walker = rejeu.SAC("MlpPolicy", "AntWalk-v0", action_repeat=4, policy_kwargs={"net_arch": [8]}, seed=0)
    body = gym.make("AntMaze_UMaze-v5", include_cfrc_ext_in_observation=False).reset(seed=0)[0]["observation"]
    body[13:15] = 0.3, -0.2
    turned = body.copy()  # by a quarter to the left, as its velocities and what it is told
    turned[1:5], turned[13:15] = np.sqrt(0.5) * np.array([1.0, 0.0, 0.0, 1.0]), [-body[14], body[13]]
    seen, seen_turned = (example["relative"](*told) for told in ((body, [0.6, 0.8]), (turned, [-0.8, 0.6])))
    np.testing.assert_allclose(seen, seen_turned, atol=1e-6)
    np.testing.assert_allclose(seen[-2:], [0.6, 0.8], atol=1e-6)
    legs = []
    maze = gym.Env()
    maze.action_space = gym.spaces.Box(-1.0, 1.0, (8,))
    maze.reset = lambda **options: ({"observation": body}, {})
    maze.step = lambda action: (legs.append(action), ({"observation": body}, 0.0, False, False, {}))[1]
    env = example["Directed"](maze, str(walker.save(tmp_path / "walker")))
    env.reset()
    for told in [[0.1, 0.2]] * 2 + [[0.0, 1.0]] * 4 + [[1.0, 0.0]]:
        env.step(np.float32(told))
    assert (np.array(legs[:2]) == 0.0).all()  # it stands
    assert (np.array(legs[2:6]) == legs[2]).all()  # held
    assert (legs[2] != 0.0).any()
    assert (legs[6] != legs[2]).any()


def test_examples_are_found():
    assert {*BY_DEFAULT, FOLDER / "parking.py", FOLDER / "resume.py"} <= {*EXAMPLES}
