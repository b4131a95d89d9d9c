"""What ``rejeu train``, ``resume`` and ``status`` measure and print: columns, times, limits."""

import csv
import json
import math
import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from filelock import FileLock

from rejeu.callbacks.evaluate import Evaluated
from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core import xla
from rejeu.core.interrupt import TAKEN
from rejeu.lab.cli import main
from rejeu.lab.reporting import rows, run_list
from rejeu.lab.runs import output, session
from rejeu.lab.runs.config import RunConfig, Task, write_task
from rejeu.lab.runs.read import read_run
from rejeu.lab.runs.session import TrainingLimits
from rejeu.logs.evaluation import Evaluation
from rejeu.logs.logging import CsvFile
from tests.lab.reporting.test_comparison import write_run


def test_an_evaluation_is_a_row_with_its_own_values_in_each_column(tmp_path, capsys):
    evaluation = Evaluation(np.array([1.0, 5.0]), np.array([10, 30]), np.array([0.0, 1.0]))
    agent = SimpleNamespace(seconds={"total": 7.0}, last_saved=None, snapshot=lambda path: lambda: path)
    report = output.reporter(agent, CsvFile(tmp_path / "table.csv"), RunFolder(tmp_path), "seed 3: ")
    report(Evaluated(40, evaluation), True)
    (row,) = csv.DictReader((tmp_path / "table.csv").read_text().splitlines())
    expected = {"step": 40, "seconds": 7, "success_rate": 0.5, "mean_return": 3, "std_return": 2}
    assert {key: float(value) for key, value in row.items()} == expected | {"mean_length": 20, "episodes": 2, "best": 1}
    assert capsys.readouterr().out == "seed 3: step        40  success  50.0%  return 3.00  (best)\n"
    report(Evaluated(50, evaluation), False)
    assert "best" not in capsys.readouterr().out


def test_goals_of_the_newest_episodes_of_evaluations_are_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(output, "MOST_GOALS", 3)
    agent = SimpleNamespace(seconds={"total": 7.0}, last_saved=None, snapshot=lambda path: lambda: path)
    agent.failed_writes = SimpleNamespace(attempt=lambda name, write, is_row: write())
    run = RunFolder(write_run(tmp_path / "run", "DQN"))
    report = output.reporter(agent, CsvFile(tmp_path / "table.csv"), run)
    for step, success in ((40, 0.0), (80, 1.0)):
        goals = np.array([[step, 1.0], [step, 2.0]])
        report(Evaluated(step, Evaluation(np.ones(2), np.ones(2, int), np.full(2, success), goals=goals)), True)
    rows = [[float(cell) for cell in row] for row in list(csv.reader(run.goals.read_text().splitlines()))[1:]]
    assert rows == [[40, 0, 40, 2], [80, 1, 80, 1], [80, 1, 80, 2]]
    assert run_list.read(run.path).goals.column("goal_1").tolist() == [2, 1, 2]


def test_the_stopwatch_counts_from_its_start_and_compilation_is_what_the_clock_leaves_out(monkeypatch):
    now = {"wall": 100.0, "clock": 60.0}
    monkeypatch.setattr(output.time, "perf_counter", lambda: now["wall"])
    monkeypatch.setattr(xla, "clock", lambda: now["clock"])
    stopwatch = output.Stopwatch()
    now.update(wall=110.0, clock=67.0)
    assert stopwatch.seconds() == (10.0, 3.0)


def test_a_pause_is_due_after_so_many_further_steps_or_minutes(monkeypatch):
    now, agent = [1000.0], SimpleNamespace(num_timesteps=30)
    monkeypatch.setattr(xla, "clock", lambda: now[0])
    by_minutes, by_steps = (
        session.pause(agent, TrainingLimits(pause_minutes=2)),
        session.pause(agent, TrainingLimits(pause_steps=5)),
    )
    never = session.pause(agent, TrainingLimits(steps=1, minutes=1))
    for seconds, steps, due in ((119, 34, False), (120, 35, True)):
        now[0], agent.num_timesteps = 1000.0 + seconds, steps
        assert (by_minutes(None), by_steps(None), never(None)) == (due, due, False)


@pytest.mark.parametrize("n", [50, 150])
def test_status_is_the_mean_of_the_last_hundred_episodes_and_the_time_that_is_left(tmp_path, n):
    run = write_run(tmp_path / "run", steps=10 * n, level=100.0)  # rises to 100 over the first half of the episodes
    found = run_list.read(run)
    returns = 100 * np.minimum(2 * np.arange(1, n + 1) / n, 1)
    metrics = "step,time/compile_seconds\n10,1\n20,2\n"
    (run / "metrics.csv").write_text(metrics, encoding="utf-8")
    (run / "agent.safetensors").unlink()
    config = json.loads((run / "config.json").read_text())
    seconds = run_list.read(run).seconds
    assert rows.describe(found).mean_return == pytest.approx(returns[-100:].mean())
    for asked, left in (({"steps": 40 * n}, 3 * (seconds - 2)), ({"steps": None, "minutes": 2}, 120 - seconds + 2)):
        (run / "config.json").write_text(json.dumps({**config, **asked}))
        (run / "checkpoints").mkdir(exist_ok=True)
        facts = rows.describe(replace(run_list.read(run), state="running"))
        assert facts.steps_per_second == pytest.approx(10 * n / (seconds - 2))
        assert facts.seconds_left == pytest.approx(left)
        minutes, rest = divmod(round(left), 60)
        words = f"{minutes} min {rest} s" if minutes else f"{rest} s"
        assert rows.rate_text(facts) == f"{10 * n / (seconds - 2):,.0f}/s, {words} left"
    facts = rows.describe(replace(run_list.read(run), state="interrupted"))
    assert (facts.episodes, facts.seconds_left, facts.seconds) == (n, None, seconds)
    best = facts.best
    assert (best.step, best.mean_return, best.success_rate) == (
        10 * n,
        101.0,
        pytest.approx(math.nan, nan_ok=True),
    )


def test_a_run_in_use_is_not_resumed_and_its_files_stay(tmp_path, capsys):
    checkpoints = tmp_path / "checkpoints"
    checkpoints.mkdir()
    (checkpoints / "lock").touch()
    with FileLock(checkpoints / "lock"):
        assert main(["resume", str(tmp_path)]) == 2
    assert "another process is training in" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoints"]


def test_a_run_without_checkpoints_is_running_while_it_trains_and_not_in_its_report(tmp_path, monkeypatch):
    states, out = [], tmp_path / "run"

    def look(*_):
        os.utime(out / "config.json", (0, 0))  # as if nothing was written for a long time
        states.append(read_run(out).state)

    monkeypatch.setattr(session.Requests, "before_training", look)
    monkeypatch.setattr(session.Session, "write_report", lambda _: states.append(read_run(out).state))
    argv = ["train", "CartPole-v1", "--algo", "DQN", "--steps", "20", "--no-video", "--out", str(out)]
    assert main([*argv, "--checkpoint-minutes", "0", "--evaluate-episodes", "1"]) == 0
    assert states == ["running", "finished"]


def test_a_process_of_a_sweep_says_that_another_one_trains_its_run(tmp_path):
    folder, task = RunFolder(tmp_path / "run"), tmp_path / "run.task"
    folder.checkpoints.mkdir(parents=True)
    for is_begun in (False, True):
        run = RunConfig(env="CartPole-v1", algorithm="DQN", steps=20, seed=0)
        write_task(task, Task(folder=str(folder.path), run=run, resume=is_begun))
        with FileLock(folder.lock):
            assert main(["--task", str(task)]) == TAKEN


@pytest.mark.parametrize(("steps", "is_due"), [([], True), ([100], True), ([100, 200], False)])
def test_a_step_is_evaluated_once(steps, is_due):
    ran = []
    evaluate = SimpleNamespace(
        results=[SimpleNamespace(step=step) for step in steps], run=lambda agent, step: ran.append(step)
    )
    session.evaluate_now(evaluate, SimpleNamespace(num_timesteps=200))
    assert ran == [200] * is_due
