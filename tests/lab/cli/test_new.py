import importlib
import shlex
import sys
import tomllib

import gymnasium as gym
import pytest

import rejeu.lab.cli
from rejeu.lab.cli.commands import COMMANDS, TASKS
from rejeu.lab.experiments.plan import read_plan
from rejeu.lab.runs import parsing


@pytest.fixture
def project(tmp_path, monkeypatch):
    """The folder of a new project, whose package can be imported."""
    assert rejeu.lab.cli.main(["new", str(tmp_path / "Tiny-Robot")]) == 0
    monkeypatch.syspath_prepend(tmp_path / "Tiny-Robot")
    yield tmp_path / "Tiny-Robot"
    gym.registry.pop("tiny_robot/Reach-v0", None)
    for name in ("tiny_robot", "tiny_robot.environment"):
        sys.modules.pop(name, None)


def test_the_tests_plan_and_commands_of_a_new_project_are_those_of_its_environment(project):
    tests = project / "tests" / "test_environment.py"
    namespace = {"__name__": "test_environment"}
    exec(compile(tests.read_text(), tests, "exec"), namespace)
    names = [name for name in namespace if name.startswith("test_")]
    assert len(names) == 2
    for name in names:
        namespace[name]()
    plan, _ = read_plan(project / "plan.toml")
    assert len(plan.jobs) == 4
    assert {job.run.env for job in plan.jobs} == {"tiny_robot/Reach-v0"}
    readme = (project / "README.md").read_text()
    commands = [line.split(maxsplit=1)[1] for line in readme.splitlines() if line.startswith("    rejeu")]
    parsed = [parsing.parse(shlex.split(command), COMMANDS, TASKS, "") for command in commands]
    assert [name for name, _ in parsed] == ["check", "train", "sweep", "studio"]
    assert parsed[-1][1].env == "tiny_robot:tiny_robot/Reach-v0"  # else the studio would not act in it
    metadata = tomllib.loads((project / "pyproject.toml").read_text())
    assert metadata["project"]["name"] == "tiny_robot"


def test_the_state_of_the_environment_of_a_new_project_goes_on_as_it_would_have(project):
    module = importlib.import_module("tiny_robot")
    env, copy = module.Reach(), module.Reach()
    env.reset(seed=3)
    copy.reset(seed=4)
    copy.set_state(env.get_state())
    action = env.action_space.high
    for _ in range(3):
        observation, reward, *_ = env.step(action)
        repeated, repeated_reward, *_ = copy.step(action)
        assert reward == repeated_reward
        assert all((observation[key] == repeated[key]).all() for key in observation)


@pytest.mark.parametrize("name", ["json", "class", "x+y", "ü", "tests", "numpy"])
def test_a_folder_that_cannot_be_a_package_of_its_own_is_refused(tmp_path, capsys, name):
    assert rejeu.lab.cli.main(["new", str(tmp_path / name)]) == 2
    assert name in capsys.readouterr().err
    assert not (tmp_path / name).exists()


def test_a_folder_with_files_is_not_changed(tmp_path, capsys):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "README.md").write_text("notes")
    assert rejeu.lab.cli.main(["new", str(tmp_path / "mine")]) == 2
    assert "not an empty folder" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["README.md"]
