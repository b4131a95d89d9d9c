"""``rejeu pbt``, ``rejeu train --pause`` and ``rejeu resume --set``."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

import rejeu
from rejeu import cli
from rejeu.experiments import process

FAKE = Path(__file__).parents[1] / "experiments" / "fake_training.py"
SMALL = ["--algo", "SAC", "--members", "4", "--rounds", "2", "--round-steps", "10", "--only", "learning_rate"]
SMALL += ["--search", "learning_rate=1e-5..4e-3"]


@pytest.fixture
def pretend(monkeypatch):
    """Lets trainings run a program that pretends."""
    monkeypatch.setattr(process, "program", lambda task: [sys.executable, "-S", str(FAKE), str(task)])
    monkeypatch.setattr("rejeu.experiments.scheduler.POLL", 0.03)
    monkeypatch.setattr(
        "rejeu.experiments.population.copy_run", lambda source, target, seed: shutil.copytree(source, target)
    )


def test_a_population_from_the_command_line(pretend, tmp_path, capsys):
    out = tmp_path / "population"
    assert cli.main(["pbt", "Pendulum-v1", *SMALL, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "population    4 members, 2 rounds of 10 steps" in printed
    assert "changing      learning_rate: 1e-05 to 0.004, logarithmic" in printed
    assert "round   1  step        20" in printed
    assert cli.main(["resume", str(out), "--json"]) == 0  # nothing is left to do
    result = json.loads(capsys.readouterr().out)
    assert result["complete"]
    assert result["best"]["score"] == max(row["score"] for row in result["history"] if row["round"] == 1)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--algo", "SACK"], "did you mean SAC?"),
        (["--only", "policy_kwargs.net_arch"], "policy_kwargs.net_arch cannot change while a run trains"),
        (["--members", "1"], "--members=1 must be a whole number of at least 2"),
        (["--rounds", "0"], "--rounds=0 must be a whole number of at least 1"),
        (["--search", "gama=0.9..0.99"], "SAC has no setting 'gama'"),
        (["--checkpoint-minutes", "0"], "checkpoint_minutes=0 must be above 0"),
        (["--round-steps", "7", "--envs", "8"], "round_steps=7 must be at least the number of environments, 8"),
    ],
)
def test_mistakes_are_one_line_and_make_no_folder(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["pbt", "Pendulum-v1", *words]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_population_of_which_a_run_cannot_be_started_decides_nothing_and_goes_on_later(
    pretend, tmp_path, monkeypatch, capsys
):
    out, start = tmp_path / "population", process.LocalLauncher.start

    def full(self, task, log, lock):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(process.LocalLauncher, "start", full)
    assert cli.main(["pbt", "Pendulum-v1", *SMALL, "--out", str(out)]) == 1
    printed = capsys.readouterr().out
    assert "member 3 in round 0 could not be started: [Errno 28] No space left on device" in printed
    assert f"not complete; rejeu resume {out} continues" in printed
    monkeypatch.setattr(process.LocalLauncher, "start", start)
    assert cli.main(["resume", str(out)]) == 0
    assert "best member" in capsys.readouterr().out


def test_a_population_takes_no_options_of_a_run(pretend, tmp_path, capsys):
    out = tmp_path / "population"
    assert cli.main(["pbt", "Pendulum-v1", *SMALL, "--rounds", "1", "--out", str(out)]) == 0
    assert cli.main(["resume", str(out), "--steps", "10"]) == 2
    assert "leave out --steps, --minutes and --set" in capsys.readouterr().err
    assert cli.main(["pbt", "Pendulum-v1", *SMALL, "--out", str(out)]) == 2
    assert "exists and is not an empty folder" in capsys.readouterr().err


def test_a_run_is_paused_and_goes_on_with_other_hyperparameters(tmp_path, capsys):
    run = tmp_path / "run"
    words = ["train", "CartPole-v1", "--algo", "PPO", "--steps", "128", "--pause", "64", "--envs", "2", "--seed", "0"]
    words += ["--set", "n_steps=16", "policy_kwargs.net_arch=[8]", "--backend", "gymnasium", "--evaluate-episodes", "2"]
    quiet = ["--no-report", "--no-video"]
    assert cli.main([*words, "--out", str(run), *quiet]) == 0
    assert "paused" in capsys.readouterr().out
    assert cli.main(["resume", str(run), "--set", "gama=0.9", *quiet]) == 2
    assert "did you mean gamma?" in capsys.readouterr().err
    assert cli.main(["resume", str(run), "--set", "gamma=0.9", "clip_range=lin_0.3", *quiet]) == 0
    agent = rejeu.load(run / "agent.safetensors")
    assert (agent.num_timesteps, agent.config.gamma, agent.config.clip_range(0.0)) == (128, 0.9, 0.3)
    assert agent.config.n_steps == 16
    config = json.loads((run / "config.json").read_text(encoding="utf-8"))
    assert config["hyperparameters"]["gamma"] == 0.9


@pytest.mark.exhaustive
@pytest.mark.skipif(os.name != "posix", reason="sends SIGKILL")
def test_a_real_population_that_is_killed_trains_the_same(tmp_path):
    words = ["pbt", "Pendulum-v1", "--algo", "SAC", "--members", "4", "--rounds", "3", "--round-steps", "1000"]
    words += ["--set", "policy_kwargs.net_arch=[8]", "batch_size=16", "--backend", "gymnasium", "--workers", "2"]
    words += ["--evaluate-episodes", "2", "--checkpoint-minutes", "0.02"]
    program = [sys.executable, "-m", "rejeu"]
    subprocess.run([*program, *words, "--out", tmp_path / "one"], capture_output=True, check=True)
    other = tmp_path / "other"
    for seconds in (15, 25):
        again = ["resume", other, "--workers", "2"] if other.exists() else [*words, "--out", other]
        process = subprocess.Popen([*program, *map(str, again)], stdout=subprocess.DEVNULL, process_group=0)
        time.sleep(seconds)
        process.kill()
        process.wait()
    subprocess.run([*program, "resume", other, "--workers", "2"], capture_output=True, check=True)
    one, two = ((folder / "history.csv").read_text() for folder in (tmp_path / "one", other))
    assert one == two
