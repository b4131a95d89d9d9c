"""``rejeu tune`` and ``rejeu resume`` of a study: output, exit status, and mistakes in one line."""

import json
import re
import subprocess
import sys

import pytest

from rejeu.lab import cli
from rejeu.lab.cli import tune as tune_command
from rejeu.lab.experiments import display, study as studies, study_plan
from rejeu.lab.runs import environment, process
from rejeu.lab.runs.config import RunConfig
from tests.lab.experiments.fake_training import Pretended

optuna = pytest.importorskip("optuna")
SMALL = ["--steps", "40", "--evaluate-every", "10", "--only", "learning_rate", "--search", "learning_rate=1e-5..4e-3"]


@pytest.fixture
def pretend(monkeypatch):
    """Lets trainings pretend, in this process."""
    monkeypatch.setattr(process.LocalLauncher, "start", lambda self, task, log: Pretended(task, log))
    monkeypatch.setattr("rejeu.lab.experiments.scheduler.POLL", 0)


def tune(*words, out):
    return cli.main(["tune", "Pendulum-v1", "--algo", "SAC", *SMALL, "--out", str(out), *words])


def test_a_study_from_the_command_line(pretend, tmp_path, capsys):
    assert tune("--trials", "3", "--final-seeds", "0", out=tmp_path / "study") == 0
    printed = capsys.readouterr().out
    assert "algorithm     SAC, seed 0, pruner median" in printed
    assert "at the end" not in printed
    assert "search        learning_rate: log:1e-05..0.004" in printed
    assert "trials        3 complete" in printed
    assert f"preset        {tmp_path / 'study' / 'preset.json'}" in printed


def test_the_final_comparison_is_announced_with_its_length(tmp_path):
    study = studies.open_study(studies.StudyFolder(tmp_path), study_plan.make("Pendulum-v1", "SAC", steps=40, trials=2))
    found = "\n".join(tune_command.header(study, environment.Environment("Pendulum-v1", RunConfig(env="Pendulum-v1"))))
    assert "at the end    the best trial and the default: 5 fresh seeds each, 10 trainings of 40 steps\n" in found


def test_a_terminal_shows_the_trials_that_run(pretend, tmp_path, capsys, monkeypatch):
    from rich.console import Console

    monkeypatch.setattr(Console, "is_terminal", True)
    monkeypatch.setattr(display, "REFRESH", 0.0)
    assert tune("--trials", "2", "--final-seeds", "0", out=tmp_path / "study") == 0
    printed = capsys.readouterr().out
    assert "1 of 2 trials have ended, best return" in printed
    assert "of 40 (" in printed
    assert "trial   1  complete" in printed


def test_result_as_json_and_continuation(pretend, tmp_path, capsys):
    assert tune("--trials", "2", "--final-seeds", "0", "--json", out=tmp_path / "study") == 0
    first = json.loads(capsys.readouterr().out)
    assert [one["state"] for one in first["trials"]] == ["complete"] * 2
    assert (first["complete"], first["signal"], first["verdict"]) == (True, None, None)
    assert tune("--trials", "3", "--final-seeds", "0", "--json", out=tmp_path / "study") == 0
    second = json.loads(capsys.readouterr().out)
    assert second["trials"][:2] == first["trials"]
    assert cli.main(["resume", str(tmp_path / "study"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == second


def test_a_study_without_a_complete_trial_exits_with_2(pretend, tmp_path, capsys):
    words = ["--trials", "2", "--search", "learning_rate=6e-3..1e-2"]
    assert tune(*words, out=tmp_path / "study") == 2
    printed = capsys.readouterr().out
    assert "trials        2 failed" in printed
    assert "best trial    none: no trial is complete" in printed
    assert "the loss is NaN" in printed


def test_a_study_of_which_a_trial_cannot_be_started_goes_on_later(pretend, tmp_path, monkeypatch, capsys):
    words, start, n_started = ["--trials", "2", "--final-seeds", "0", "--workers", "1"], process.LocalLauncher.start, 0

    def full(self, task, log):
        nonlocal n_started
        n_started += 1
        if n_started > 1:
            raise OSError(28, "No space left on device")
        return start(self, task, log)

    monkeypatch.setattr(process.LocalLauncher, "start", full)
    assert tune(*words, out=tmp_path / "study") == 1
    printed = capsys.readouterr().out
    assert "trials        1 complete, 1 running" in printed
    assert re.search(r"note +trial 0001, seed \d+ could not be started: \[Errno 28\] No space left on device", printed)
    monkeypatch.setattr(process.LocalLauncher, "start", start)
    assert tune(*words, out=tmp_path / "study") == 0
    assert "trials        2 complete" in capsys.readouterr().out


def test_folders_of_other_studies_are_one_line(pretend, tmp_path, capsys):
    assert tune("--trials", "1", "--final-seeds", "0", out=tmp_path / "study") == 0
    assert cli.main(["tune", "MountainCarContinuous-v0", "--algo", "SAC", "--out", str(tmp_path / "study")]) == 2
    assert "is another study: env_id is Pendulum-v1 there, not MountainCarContinuous-v0" in capsys.readouterr().err
    assert cli.main(["resume", str(tmp_path / "study"), "--env", "MountainCarContinuous-v0"]) == 2
    assert "is a study of Pendulum-v1, not of MountainCarContinuous-v0" in capsys.readouterr().err
    assert cli.main(["resume", str(tmp_path / "study"), "--steps", "10"]) == 2
    assert "leave out --steps and --minutes" in capsys.readouterr().err
    (tmp_path / "study" / "journal.log").write_bytes(b"\xff\xff\n" * 5)
    assert cli.main(["resume", str(tmp_path / "study")]) == 2
    assert "journal.log is damaged" in capsys.readouterr().err


REAL = ["tune", "CartPole-v1", "--algo", "PPO", "--envs", "4", "--backend", "gymnasium", "--evaluate-episodes", "5"]
REAL += ["--set", "n_epochs=1", "--only", "learning_rate", "gamma", "--workers", "1", "--checkpoint-minutes", "0.02"]


def command(*words):
    return [sys.executable, "-m", "rejeu", *map(str, words)]


@pytest.mark.exhaustive
def test_the_preset_of_a_real_study_trains(tmp_path):
    out = tmp_path / "study"
    words = [*REAL, "--trials", 3, "--steps", 2000, "--final-seeds", 5, "--trial-seeds", 2, "--out", out, "--json"]
    done = subprocess.run(command(*words), capture_output=True, text=True, check=True)
    result = json.loads(done.stdout)
    assert [one["state"] for one in result["trials"]] == ["complete"] * 3
    assert result["verdict"] in ("better", "worse", "no difference found")
    assert [row["runs"] for row in result["comparison"]] == [5, 5]
    words = ["train", "CartPole-v1", "--preset", out / "preset.json", "--out", tmp_path / "run", "--no-video"]
    subprocess.run(command(*words), capture_output=True, check=True)
