"""Environments of the user's own on the command line: what is typed is imported, what a run folder says never is."""

import dataclasses
import io
import json
import os
import random
import shlex
import shutil
import sys

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.core.errors import WorkerError
from rejeu.lab.cli import main
from rejeu.lab.experiments.work import Job, again
from rejeu.lab.runs import begin, environment
from rejeu.lab.runs.arguments import Train
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.runs.environment import Environment
from rejeu.lab.runs.read import read_run
from rejeu.logs.formatting import quoted
from tests.helpers import error_of
from tests.lab.cli.test_cli import FEWER_FILES, TINY

pytestmark = pytest.mark.usefixtures("learners_are_shared")

SOURCE = """
import gymnasium as gym, numpy as np

class Drift(gym.Env):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}
    observation_space = gym.spaces.Box(np.array([-1, -1, -8], np.float32), np.array([1, 1, 8], np.float32))
    action_space = gym.spaces.Box(-2, 2, (1,))

    def __init__(self, gain=1.0, offsets=(), render_mode=None):
        self.gain, self.render_mode = gain, render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = 0.0
        return np.zeros(3, np.float32), {}

    def step(self, action):
        self.x += float(action[0])
        return np.zeros(3, np.float32), self.gain, False, False, {}

    def render(self):
        return np.zeros((16, 16, 3), np.uint8)

class Double(gym.RewardWrapper):
    def reward(self, reward):
        return 2 * reward

gym.register("Drift-v0", "drift_env:Drift", max_episode_steps=10)
"""
"""Every step of an episode of 10 is worth ``gain``, whatever is done. The spaces are those of Pendulum, for which there is
a compiled program."""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with ``drift_env.py``, which is the current one; what it registers and imports is forgotten afterwards."""
    (tmp_path / "drift_env.py").write_text(SOURCE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield tmp_path
    gym.registry.pop("Drift-v0", None)
    sys.modules.pop("drift_env", None)


def train(*named, out="run"):
    argv = ["train", *named, "--algo", "SAC", "--steps", "60", "--seed", "0", "--out", out, "--evaluate-episodes", "1"]
    assert main([*argv, *FEWER_FILES, "--set", *TINY, "learning_rate=1e-3"]) == 0


def test_a_run_stays_whole_where_the_environment_changes_the_current_folder(here):
    elsewhere = here / "elsewhere"
    elsewhere.mkdir()
    source = SOURCE.replace(
        "        self.x += ", f"        import os; os.chdir({str(elsewhere)!r})\n        self.x += "
    )
    (here / "drift_env.py").write_text(source)
    train("drift_env.py")
    assert list(elsewhere.iterdir()) == []
    run = read_run(here / "run")
    assert (run.state, run.steps, len(run.evaluations), run.notes) == ("finished", 60, 1, ())


def forget():
    """Stands for a new process."""
    gym.registry.pop("Drift-v0", None)
    sys.modules.pop("drift_env", None)


@pytest.mark.parametrize(("named", "out"), [("drift_env:Drift-v0", "run"), ("drift_env.py", "été 1/run")])
def test_the_command_that_train_prints_works_for_an_environment_of_ones_own(named, out, here, capsys):
    train(named, out=out)
    hint = capsys.readouterr().out.strip().splitlines()[-1]
    assert hint == f"try it        rejeu evaluate {quoted(out)} --env {named} --backend gymnasium"
    forget()
    assert main([*shlex.split(hint.partition("rejeu ")[2]), "--episodes", "1"]) == 0
    assert "return 10.00" in capsys.readouterr().out
    forget()
    assert main(["record", out, "--env", named, "--episodes", "1"]) == 0
    forget()
    assert main(["resume", out, "--env", named, "--steps", "20", *FEWER_FILES]) == 0
    assert rejeu.load(f"{out}/agent").num_timesteps == 80


def test_commands_to_type_name_what_was_imported():
    made = Environment("CartPole-v1", RunConfig(env="CartPole-v1", imports=("awac.py",)))
    assert made.run.again() == " --import awac.py"
    run = RunConfig(env="my_env.py", seed=0, env_kwargs={"g": 9.8}, wrappers=("my_env:Double",))
    typed = dataclasses.replace(run, imports=("awac.py",))
    assert (
        again([Job(name="seed_0", run=run)], typed)
        == " --env my_env.py --env-kwargs g=9.8 --wrapper my_env:Double --import awac.py"
    )


def test_a_file_in_a_folder_with_py_in_its_name_and_one_that_registers_a_class(here):
    folder = here / "my.pyproject"
    folder.mkdir()
    (here / "drift_env.py").rename(folder / "drift_env.py")
    for named in ("my.pyproject/drift_env.py", "my.pyproject/drift_env.py:Drift-v0"):
        assert main(["check", named]) == 0
    forget()
    (here / "drift_env.py").write_text(SOURCE.replace('"drift_env:Drift"', "Drift"))
    sys.path.remove(str(folder))
    assert main(["check", "drift_env.py", "--wrapper", "drift_env:Double"]) == 0  # imported for its wrapper first


@pytest.mark.parametrize("name", ["drift.env", ".drift"])
def test_a_file_whose_name_no_module_can_have_is_to_be_renamed(here, capsys, name):
    (here / "drift_env.py").rename(here / f"{name}.py")
    advice = f"the name of a module has no dot; rename {name}.py to {name.replace('.', '_')}.py"
    assert advice in error_of(capsys, "check", f"{name}.py:Drift-v0")
    assert advice in error_of(capsys, "check", "CartPole-v1", "--import", f"{name}.py")


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("def f(:\n", "drift_env.py cannot be imported: SyntaxError: invalid syntax (drift_env.py, line 1)"),
        ("\nx = y\n", "NameError: name 'y' is not defined (drift_env.py, line 2, in <module>)"),
        ("import no_such\n", "No module named 'no_such' (drift_env.py, line 1, in <module>)"),
    ],
)
def test_a_file_that_cannot_be_imported_is_one_line(source, message, here, capsys):
    (here / "drift_env.py").write_text(source)
    assert message in error_of(capsys, "check", "drift_env.py")


def test_a_step_of_four_values_is_explained(here, capsys):
    (here / "drift_env.py").write_text(SOURCE.replace("self.gain, False, False, {}", "self.gain, False, {}"))
    assert "; step must return observation, reward, terminated, truncated and info" in error_of(
        capsys, "check", "drift_env.py"
    )


def test_a_traceback_from_a_worker_process_keeps_its_lines(monkeypatch, capsys):
    def fail(arguments):
        raise WorkerError("environment 0 failed in a worker process:\nTraceback\n  line 3")

    monkeypatch.setattr("rejeu.lab.cli.list.run_list", fail)
    assert main(["list"]) == 2
    assert "process:\nTraceback\n  line 3 (" in capsys.readouterr().err


@pytest.mark.parametrize("problem", ["raise ValueError('no gain')", "return int('no gain')"])
def test_an_error_of_ones_own_code_says_where(problem, here, capsys):
    source = here / "drift_env.py"
    source.write_text(SOURCE.replace("self.x += float(action[0])", problem))
    line = source.read_text().splitlines().index(f"        {problem}") + 1
    argv = [
        "train",
        "drift_env.py",
        "--algo",
        "SAC",
        "--steps",
        "9",
        "--out",
        "run",
        "--set",
        *TINY,
        "learning_rate=1e-3",
    ]
    assert f"(drift_env.py, line {line}, in step)" in error_of(capsys, *argv)


def test_keyword_arguments_and_wrappers_are_used_while_training_and_named_in_the_hint(here, capsys):
    train("drift_env.py", "--env-kwargs", "gain=3", "--wrapper", "drift_env:Double")
    text = capsys.readouterr().out
    assert "environment   Drift-v0 (gain=3), drift_env:Double, 1 at once" in text
    assert "return 60.00" in text  # 10 steps of twice 3
    assert text.splitlines()[-1].endswith(
        "rejeu evaluate run --env drift_env.py --env-kwargs gain=3 --wrapper drift_env:Double --backend gymnasium"
    )


def test_check_takes_a_file_and_keyword_arguments(here, capsys):
    assert main(["check", "drift_env.py", "--env-kwargs", "gain=high"]) == 1
    assert "reward 'high' of type str" in capsys.readouterr().out


def test_modules_are_found_in_the_current_folder(here, monkeypatch, capsys):
    monkeypatch.setattr(
        sys, "path", [path for path in sys.path if path not in ("", str(here))]
    )  # as of a console script
    assert main(["check", "drift_env:Drift-v0"]) == 0
    assert "Drift-v0: 0 errors" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("named", "message"),
    [
        (["no_such_env:X-v0"], "there is no module 'no_such_env' in"),
        (["no_such_env.py"], "there is no file no_such_env.py"),
        (["drift_env"], "no environment is called 'drift_env'; did you mean the file drift_env.py?"),
        (["drift_env:Drif-v0"], "drift_env registers Drift-v0, not 'Drif-v0'"),
        (["empty_env.py"], "empty_env.py registers no environment; add gymnasium.register("),
        (
            ["zoo_env.py"],
            "zoo_env.py has an environment of several agents, as PettingZoo's, and rejeu trains one agent",
        ),
        (["two_env.py"], "two_env.py registers A-v0 and B-v0; name one of them: two_env.py:A-v0"),
        (["Pendulum-v1", "--wrapper", "drift_env"], "must be MODULE:CLASS"),
        (["Pendulum-v1", "--wrapper", "drift_env:Triple"], "has no class or function 'Triple'"),
        (["Pendulum-v1", "--env-kwargs", "g"], "--env-kwargs 'g' must be name=value"),
    ],
)
def test_what_cannot_be_found_is_one_line(named, message, here, capsys):
    (here / "empty_env.py").write_text("x = 1\n")
    (here / "zoo_env.py").write_text("class Game:\n    __module__ = 'pettingzoo.utils.env'\n")
    (here / "two_env.py").write_text(
        "import gymnasium\nfor name in 'AB':\n    gymnasium.register(f'{name}-v0', 'two_env:X')\n"
    )
    try:
        assert message in error_of(capsys, "check", *named)
    finally:
        for name in ("A-v0", "B-v0"):
            gym.registry.pop(name, None)
        sys.modules.pop("two_env", None)


@pytest.fixture(scope="module")
def registered_run(tmp_path_factory):
    """The folder of a short run on a registered environment, with a keyword argument."""
    out = tmp_path_factory.mktemp("runs") / "pendulum"
    train("Pendulum-v1", "--env-kwargs", "g=2", out=str(out))
    return out


def test_plain_keyword_arguments_of_a_registered_environment_are_read_from_the_run(registered_run, capsys):
    assert main(["evaluate", str(registered_run), "--episodes", "1"]) == 0
    assert "Pendulum-v1 (g=2) on gymnasium" in capsys.readouterr().out
    assert main(["evaluate", str(registered_run), "--episodes", "1", "--env-kwargs", "g=1"]) == 0
    assert "Pendulum-v1 (g=1) on gymnasium" in capsys.readouterr().out


def test_plain_keyword_arguments_are_read_from_a_model_outside_of_a_run(registered_run, tmp_path, capsys):
    shutil.copy(registered_run / "agent.safetensors", tmp_path / "copy.safetensors")
    assert main(["evaluate", str(tmp_path / "copy"), "--episodes", "1"]) == 0
    assert "Pendulum-v1 (g=2) on gymnasium" in capsys.readouterr().out


def test_a_model_of_the_course_of_training_is_that_of_its_run(registered_run, tmp_path, capsys):
    run = shutil.copytree(registered_run, tmp_path / "run")
    config = json.loads((run / "config.json").read_text("utf-8"))
    config["wrappers"] = ["gymnasium.wrappers:ClipReward"]
    (run / "config.json").write_text(json.dumps(config), "utf-8")
    (run / "models").mkdir(exist_ok=True)
    shutil.copy(run / "agent.safetensors", run / "models" / "step_000000000060.safetensors")
    assert main(["evaluate", str(run / "models" / "step_000000000060.safetensors"), "--episodes", "1"]) == 2
    assert "--wrapper gymnasium.wrappers:ClipReward" in capsys.readouterr().err


EVIL = [
    {"env": "evil_env:Pendulum-v1"},
    {"env": "evil_env.py"},
    {"env": "os:system"},
    {"env_argument": "evil_env:Pendulum-v1"},
    {"wrappers": ["evil_env:Wrapper"]},
    {"env_kwargs": {"g": "evil_env:Wrapper"}},
    {"env_kwargs": {"g": "/etc/passwd"}},
    {"env_kwargs": {"g": [1.0]}},
    {"env_kwargs": {"g": 10**12}},
]


@pytest.mark.parametrize("lie", EVIL, ids=json.dumps)
def test_a_run_folder_imports_nothing_and_says_what_to_type(lie, registered_run, tmp_path, monkeypatch, capsys):
    run = tmp_path / "run"
    shutil.copytree(registered_run, run)
    (run / "evil_env.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.chdir(run)
    monkeypatch.syspath_prepend(run)
    config = run / "config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), **lie}))
    error = error_of(capsys, "resume", ".")
    assert " --env " in error
    assert "evil_env" not in sys.modules


def test_output_to_a_pipe_whose_encoding_lacks_a_character(registered_run, monkeypatch):
    pipe = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", pipe)
    assert main(["evaluate", str(registered_run), "--episodes", "1"]) == 0
    pipe.flush()
    assert b" ? " in pipe.buffer.getvalue()


def test_a_folder_of_runs_names_the_newest_inside(registered_run, tmp_path, capsys):
    for name, time in (("a", 2.0), ("newest", 3.0), ("z", 1.0)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").touch()
        os.utime(tmp_path / name / "config.json", (time, time))
    assert f"the newest of the 3 in it is {tmp_path / 'newest'}" in error_of(capsys, "evaluate", str(tmp_path))
    assert f"the newest of the 1 in it is {registered_run}" in error_of(capsys, "evaluate", str(registered_run.parent))
    assert f"the newest of the 1 in it is {registered_run}" in error_of(capsys, "resume", str(registered_run.parent))


WRONG = """
import gymnasium as gym, numpy as np

class Wrong(gym.Env):
    observation_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self):
        return np.zeros(2)

    def step(self, action):
        return np.zeros(2), np.array([1.0]), 0, False, []

gym.register("Wrong-v0", "wrong_env:Wrong")
"""


@pytest.mark.parametrize(
    ("arguments", "fault"), [("self", "takes no seed"), ("self, *, seed=None", "takes no options")]
)
def test_check_finds_all_errors_and_train_refuses_with_the_same_lines(arguments, fault, here, capsys):
    name = fault.replace(" ", "_")
    wrong = WRONG.replace("reset(self)", f"reset({arguments})").replace("Wrong-v0", f"{name}-v0")
    (here / f"{name}.py").write_text(wrong.replace("wrong_env", name))
    assert main(["check", f"{name}.py"]) == 1
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("error: ")]
    parts = [fault, "reset returned the observation only", "dtype float64", "shape (1,)", "terminated=0", "info"]
    assert len(lines) == len(parts)
    assert all(any(part in line for line in lines) for part in parts)
    assert main(["train", f"{name}.py", "--steps", "10", "--out", "run"]) == 2
    assert capsys.readouterr().err.splitlines()[: len(lines)] == lines
    assert not (here / "run").exists()


def test_the_check_before_training_draws_no_random_numbers_of_others(here):
    drawing = SOURCE.replace("self.x = 0.0", "self.x = 0.0 * np.random.random()")
    (here / "drift_env.py").write_text(drawing, encoding="utf-8")
    made = environment.from_arguments("drift_env.py", Train(env="drift_env.py"))
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002
    expected = random.getstate(), np.random.get_state()[1].tolist()  # noqa: NPY002
    begin.check_own_environment(made, None)
    assert (random.getstate(), np.random.get_state()[1].tolist()) == expected  # noqa: NPY002
