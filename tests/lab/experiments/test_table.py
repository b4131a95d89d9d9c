"""What is shown while a sweep trains."""

import json
import re

from rich.console import Console

from rejeu.core.interrupt import Interrupt
from rejeu.lab.experiments import display, sweep
from rejeu.lab.experiments.folder import Plan, open_folder
from rejeu.lab.experiments.scheduler import Scheduler
from rejeu.lab.experiments.work import Job
from rejeu.lab.runs.config import RunConfig
from tests.lab.experiments.test_scheduler import Launcher
from tests.lab.reporting.test_comparison import write_run


def make(tmp_path):
    """Returns the scheduler in the middle of a sweep: a run is done, one trains, one has failed, one waits."""
    jobs = tuple(Job(name=f"job-{i}", run=RunConfig(env="CartPole-v1", seed=i, steps=1000)) for i in range(4))
    folder = open_folder(tmp_path / "sweep", Plan(jobs=jobs, threads=1), None, RunConfig(env=""))
    works = folder.works()
    write_run(works[0].path, level=100.0)
    works[0].write_exit(0)
    works[1].write_exit(2)
    scheduler = Scheduler(Launcher(capacity=1, ends={"job-2": [None]}), Interrupt())
    scheduler.add(folder.works())
    scheduler.turn()
    metrics = "step,time/time_elapsed,rollout/ep_rew_mean\n250,5,20\n500,10,30\n"
    (works[2].path / "metrics.csv").write_text(metrics, encoding="utf-8")
    config = {"env": "CartPole-v1", "algorithm": "PPO", "steps": 1000}
    (works[2].path / "config.json").write_text(json.dumps(config), encoding="utf-8")
    return scheduler


def show(scheduler, monkeypatch, capsys):
    """Returns what the display prints of a scheduler."""
    monkeypatch.setattr(display, "LINES", 0.0)
    with display.shown(scheduler, lambda: sweep.states_text(scheduler.works)) as watch:
        watch()
    return capsys.readouterr().out


def test_lines_say_how_far_the_runs_are_that_train(tmp_path, monkeypatch, capsys):
    scheduler = make(tmp_path)
    states = "1 running, 1 done, 1 failed, 1 waiting"
    assert (
        show(scheduler, monkeypatch, capsys) == f"job-2 500 of 1,000 (50%) steps, return 30.00 in training; {states}\n"
    )
    (scheduler.works[2].path / "agent.safetensors").touch()
    scheduler.running[0].handle.status = 0
    while scheduler.running:
        scheduler.turn()
    assert show(scheduler, monkeypatch, capsys) == ""


def test_a_terminal_shows_a_table_of_them(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(Console, "is_terminal", True)
    monkeypatch.setenv("COLUMNS", "200")
    printed = show(make(tmp_path), monkeypatch, capsys)
    assert re.search(r"job-2 +CartPole-v1 .*500 of 1,000", printed)
    assert "job-0" not in printed
    assert "1 running, 1 done, 1 failed, 1 waiting" in printed
