"""The table of a sweep."""

import math

from rich.progress import Progress, TextColumn

from rejeu.core.interrupt import Interrupt
from rejeu.lab.experiments import sweep
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
    return scheduler


def test_a_terminal_shows_bars_and_another_output_lines(tmp_path):
    scheduler = make(tmp_path)
    done, _, running, waiting = (task.progress() for task in scheduler.works)
    assert (done.step, done.best) == (1000, 101.0)
    assert running[:2] == (500, 30.0)
    assert (waiting.step, math.isnan(waiting.mean_return)) == (0, True)
    with Progress(TextColumn("{task.description} {task.fields[text]}")) as bars:
        sweep.draw(bars, sweep.rows(scheduler))
        everything, one = bars.tasks
    assert (one.description, one.completed, one.total) == ("job-2", 500, 1000)
    assert (everything.completed, everything.total) == (1500, 3000)  # the failed run is not trained
    states = "1 running, 1 done, 1 failed, 1 waiting"
    assert everything.fields["text"] == states
    assert sweep.line(sweep.rows(scheduler)) == f"job-2 500 of 1,000 steps, return 30.00; {states}"
    assert sweep.states_text(scheduler.outcomes()) == states
    (scheduler.works[2].path / "agent.safetensors").touch()
    scheduler.running[0].handle.status = 0
    while scheduler.running:
        scheduler.turn()
    with Progress() as bars:
        bars.add_task("job-2", text="")
        sweep.draw(bars, sweep.rows(scheduler))
        assert "job-2" not in {task.description for task in bars.tasks}
