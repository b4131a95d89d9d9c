"""The description of a run: declared once, read from files of every version, and handed to processes as data."""

import dataclasses
import json

import numpy as np
import pytest

import rejeu
from rejeu.core.errors import CheckpointError
from rejeu.lab.cli import commands, main
from rejeu.lab.runs import config, parsing
from rejeu.lab.runs.arguments import of_task
from rejeu.lab.runs.config import DecidedRun, RunConfig, Task, read_task, write_task
from tests.lab.cli.test_cli import FEWER_FILES, TINY
from tests.tiers import exhaustive

CONTENT = {
    "env": "Pendulum-v1",
    "algorithm": "SAC",
    "preset": True,
    "hyperparameters": {"gamma": 0.9},
    "policy": "MlpPolicy",
    "seed": 3,
    "n_envs": 1,
    "backend": "gymnasium",
    "steps": 850,
    "minutes": None,
    "success_threshold": None,
    "video_every": 700,
    "evaluate_every": 400,
    "evaluate_episodes": 2,
    "checkpoint_minutes": None,
    "versions": {"python": "3.11.7"},
}
"""What an early version wrote to ``config.json``."""

RUNS = {
    "little": RunConfig(env="CartPole-v1"),
    "negative": RunConfig(env="CartPole-v1", success_threshold=-1e-05),
    "much": RunConfig(
        env="my_env:Walk-v0",
        env_kwargs={"g": 9.8, "map.size": [1, 2]},
        wrappers=("a:B", "c:D"),
        imports=("my_algorithm.py",),
        algorithm="PPO",
        n_envs=8,
        seed=0,
        steps=10**12,
        success_threshold=0.1234567890123,
        checkpoint_minutes=0.0,
        hyperparameters={
            "gamma": 0.9,
            "learning_rate": 0.000123456789,
            "policy_kwargs.net_arch": [8],
            "train_freq": [1, "episode"],
        },
        log=("json", "wandb"),
    ),
}

pytestmark = pytest.mark.usefixtures("learners_are_shared")


@pytest.mark.parametrize(
    "changed",
    [
        {"n_envs": 10**6},
        {"seed": -1},
        {"steps": 1.5},
        {"device": "tpu"},
        {"log": ["print"]},
        {"algorithm": None},
        {"minutes": 3.0},
        {"hyperparameters": []},
        {"evaluate_episodes": 10**9},
        {"env_kwargs": {"--import": "evil.py"}},
        {"env_kwargs": []},
        {"n_envs": 0},
        {"evaluate_every": 0},
        {"video_every": -1},
        {"steps": 0},
        {"minutes": -1.0, "steps": None},
        {"checkpoint_minutes": float("nan")},
        {"success_threshold": float("inf")},
        {"wrappers": [1]},
    ],
)
def test_what_is_out_of_range_is_damaged(tmp_path, changed):
    path = tmp_path / "config.json"
    path.write_text(json.dumps({**CONTENT, **changed}))
    with pytest.raises(CheckpointError, match=r"config\.json is damaged"):
        config.read(path)


@pytest.mark.parametrize("run", RUNS.values(), ids=RUNS)
def test_a_run_is_the_same_as_words_of_the_command_line_and_as_data(run, tmp_path):
    command, arguments = parsing.parse(run.words(), commands.COMMANDS, {}, "")
    assert command == "train"
    assert {one.name: getattr(arguments, one.name) for one in dataclasses.fields(run)} == dataclasses.asdict(run)
    write_task(tmp_path / "task.json", Task(folder="runs/1", run=run))
    command, arguments = of_task(read_task(tmp_path / "task.json"))
    assert {one.name: getattr(arguments, one.name) for one in dataclasses.fields(run)} == dataclasses.asdict(run)
    assert (command, str(arguments.out), arguments.pause) == ("train", "runs/1", None)
    task = Task(folder="runs/1", run=run, resume=True, no_report=True)
    command, arguments = of_task(task)
    assert (command, str(arguments.run), arguments.steps, arguments.finish) == ("resume", "runs/1", None, True)
    assert (arguments.hyperparameters, arguments.no_report, arguments.no_video) == ({}, True, False)
    assert (arguments.imports, arguments.env_kwargs) == (run.imports, run.env_kwargs if run.names_code else {})
    assert (arguments.env, arguments.wrappers) == (run.env if run.names_code else None, run.wrappers)


def test_every_field_of_a_decided_run_is_one_of_a_run():
    assert [one.name for one in dataclasses.fields(DecidedRun)] == [one.name for one in dataclasses.fields(RunConfig)]


@exhaustive
def test_a_process_trains_and_continues_what_its_file_says(tmp_path):
    settings = {"policy_kwargs.net_arch": [8], "learning_starts": 50, "batch_size": 8, "buffer_size": 5000}
    run = RunConfig(
        env="Pendulum-v1", algorithm="SAC", seed=3, steps=120, evaluate_episodes=1, hyperparameters=settings
    )
    words = ["train", "Pendulum-v1", "--algo", "SAC", "--seed", "3", "--steps", "120", "--evaluate-episodes", "1"]
    for folder, pause in (("words", []), ("continued", ["--pause", "70"])):
        assert main([*words, "--out", str(tmp_path / folder), *pause, *FEWER_FILES, "--set", *TINY]) == 0
    for folder, resume in (("begun", False), ("continued", True)):
        one = Task(folder=str(tmp_path / folder), run=run, resume=resume, no_report=True, no_video=True)
        write_task(tmp_path / "task.json", one)
        assert main(["--task", str(tmp_path / "task.json")]) == 0
    expected = rejeu.load(tmp_path / "words" / "agent.safetensors").get_parameters()
    for folder in ("begun", "continued"):
        for name, value in rejeu.load(tmp_path / folder / "agent.safetensors").get_parameters().items():
            np.testing.assert_array_equal(value, expected[name], err_msg=f"{folder}, {name}")
