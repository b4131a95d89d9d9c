"""``rejeu train --seeds``."""

import dataclasses
import json
import os
import sys
from pathlib import Path

import pytest

from rejeu.lab import cli
from rejeu.lab.cli import sweep
from rejeu.lab.experiments import scheduler
from rejeu.lab.runs import process
from rejeu.lab.runs.arguments import Train
from rejeu.lab.runs.config import RunConfig
from tests.lab.reporting.test_comparison import write_run

PROGRAM = """
import json, sys
seed = json.load(open(sys.argv[1]))["run"]["seed"]
print("the seed is", seed)
sys.exit(2 * (seed == 1))
"""


@pytest.fixture
def other_program(monkeypatch):
    """Runs another program in the place of ``rejeu``, and writes the run folders."""
    start = process.LocalLauncher.start

    def start_other(self, task, log):
        content = json.loads(task.read_text(encoding="utf-8"))
        seed = content["run"]["seed"]
        write_run(Path(content["folder"]), seed=seed, level=10.0 + seed)
        return start(self, task, log)

    monkeypatch.setattr(process.LocalLauncher, "start", start_other)
    monkeypatch.setattr(process, "program", lambda task: [sys.executable, "-c", PROGRAM, str(task)])


def test_a_seed_that_fails_keeps_its_log_and_does_not_stop_the_others(tmp_path, other_program, capsys):
    out = tmp_path / "out"
    assert cli.main(["train", "CartPole-v1", "--seeds", "4", "--jobs", "2", "--seed", "0", "--out", str(out)]) == 2
    printed = capsys.readouterr().out
    assert "seed 1 failed with exit status 2: the seed is 1" in printed
    assert "DQN on CartPole-v1: IQM" in printed
    assert "4 runs" in printed
    folders = [path.name for path in out.iterdir() if path.is_dir() and path.name[0] != "."]
    assert sorted(folders) == [f"seed_{seed}" for seed in range(4)]
    for seed in range(4):
        assert (out / f"seed_{seed}.log").read_text(encoding="utf-8").strip() == f"the seed is {seed}"


def test_result_as_json(tmp_path, other_program, capsys):
    assert (
        cli.main(["train", "CartPole-v1", "--seeds", "2", "--seed", "2", "--json", "--out", str(tmp_path / "a")]) == 0
    )
    content = json.loads(capsys.readouterr().out)
    assert [(row["seed"], row["exit_status"]) for row in content["runs"]] == [(2, 0), (3, 0)]
    assert content["comparison"][0]["runs"] == 2


def test_options_are_passed_on():
    arguments = Train(
        env="CartPole-v1",
        algorithm="DQN",
        steps=500,
        seeds=1,
        seed=1,
        checkpoint_minutes=0.5,
        imports=("my_module",),
        hyperparameters={"gamma": 0.9, "train_freq": [1, "episode"]},
        log=("json",),
    )
    (job,) = sweep.make_jobs(arguments)
    task = job.task(Path("OUT"), False, arguments.imports)
    given = {one.name: getattr(arguments, one.name) for one in dataclasses.fields(RunConfig)}
    assert (task.folder, task.run, task.resume) == ("OUT", RunConfig(**given), False)


def test_the_address_of_a_cluster_is_in_no_file(monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "")
    arguments = Train(env="CartPole-v1", seeds=2, seed=1, backend="ray", ray="10.0.0.1:6379")
    assert {job.run.ray for job in sweep.make_jobs(arguments)} == {"auto"}
    assert os.environ["RAY_ADDRESS"] == "10.0.0.1:6379"


def test_a_mistake_is_found_before_anything_starts(tmp_path, capsys):
    out = tmp_path / "out"
    assert cli.main(["train", "CartPole-v1", "--seeds", "2", "--set", "gamma", "--out", str(out)]) == 2
    assert "must be name=value" in capsys.readouterr().err
    assert not out.exists()
    assert cli.main(["train", "CartPole-v1", "--seeds", "2", "--pause", "10"]) == 2
    assert "--pause is for a single run" in capsys.readouterr().err
    assert cli.main(["train", "CartPole-v1", "--jobs", "2"]) == 2
    assert "--jobs is for several seeds" in capsys.readouterr().err
    mistakes = {
        "--backend": "--backend='typo' must be one of auto, envpool",
        "--device": "--device='typo' must be",
        "--log": "--log contains 'typo', expected",
        "--algo": "no algorithm is called 'typo'",
    }
    for option, message in mistakes.items():
        assert cli.main(["train", "CartPole-v1", "--seeds", "2", option, "typo", "--out", str(out)]) == 2
        assert message in capsys.readouterr().err
        assert not out.exists()


def test_a_seed_that_cannot_be_started_is_left_and_said(tmp_path, monkeypatch, other_program, capsys):
    start = process.LocalLauncher.start

    def full(self, task, log):
        if "seed_1" in log.name:
            raise OSError(28, "No space left on device")
        return start(self, task, log)

    monkeypatch.setattr(process.LocalLauncher, "start", full)
    out = tmp_path / "out"
    monkeypatch.setattr(scheduler, "POLL", 0.03)
    assert cli.main(["train", "CartPole-v1", "--seeds", "2", "--seed", "1", "--out", str(out)]) == 1
    assert "seed 1 could not be started: [Errno 28] No space left on device" in capsys.readouterr().out


@pytest.mark.exhaustive  # starts three processes that train, half a minute
def test_two_seeds_are_trained_and_compared(tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["--algo", "DQN", "--steps", "600", "--seeds", "2", "--seed", "3", "--no-report", "--out", str(out)]
    assert cli.main(["train", "CartPole-v1", *arguments]) == 0
    assert "2 runs" in capsys.readouterr().out
    assert (out / "seed_4" / "agent.safetensors").is_file()
