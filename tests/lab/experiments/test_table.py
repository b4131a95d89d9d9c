"""The table of a sweep."""

import math

from rich.progress import Progress, TextColumn

from rejeu.core.interrupt import Interrupt
from rejeu.lab.experiments import sweep
from rejeu.lab.experiments.folder import Job, Sweep, open_folder
from rejeu.lab.experiments.sweep import Coordinator
from rejeu.lab.runs.config import RunConfig
from tests.lab.experiments.test_scheduler import Launcher
from tests.lab.reporting.test_comparison import write_run


def make(tmp_path):
    """Returns a coordinator in the middle of a sweep: a run is done, one trains, one has failed, one waits."""
    jobs = tuple(Job(name=f"job-{i}", run=RunConfig(env="CartPole-v1", seed=i, steps=1000)) for i in range(4))
    folder = open_folder(tmp_path / "sweep", Sweep(jobs=jobs, threads=1), None, RunConfig(env=""))
    works = folder.works()
    write_run(works[0].run, level=100.0)
    works[0].write_exit(0)
    works[1].write_exit(2)
    coordinator = Coordinator(folder, Launcher(capacity=1, ends={"job-2": [None]}), Interrupt(), RunConfig(env=""))
    coordinator.scheduler.turn()
    metrics = "step,time/time_elapsed,rollout/ep_rew_mean\n250,5,20\n500,10,30\n"
    (works[2].run / "metrics.csv").write_text(metrics, encoding="utf-8")
    return coordinator


def test_a_terminal_shows_bars_and_another_output_lines(tmp_path):
    coordinator = make(tmp_path)
    done, _, running, waiting = (task.progress() for task in coordinator.tasks)
    assert (done.step, done.best) == (1000, 101.0)
    assert running[:3] == (500, 10.0, 30.0)
    assert (waiting.step, math.isnan(waiting.mean_return)) == (0, True)
    with Progress(TextColumn("{task.description} {task.fields[text]}")) as bars:
        sweep.draw(bars, sweep.rows(coordinator))
        everything, one = bars.tasks
    assert (one.description, one.completed, one.total) == ("job-2", 500, 1000)
    assert (everything.completed, everything.total) == (1500, 3000)  # the failed run is not trained
    states = "1 running, 1 done, 1 failed, 1 waiting"
    assert everything.fields["text"] == states
    assert sweep.line(coordinator) == f"job-2 500 of 1,000 steps, return 30.00; {states}"
    assert sweep.closing_lines(coordinator)[0] == f"4 runs: {states}"
    (coordinator.tasks[2].run / "agent.safetensors").touch()
    coordinator.scheduler.running[0].handle.status = 0
    while coordinator.scheduler.running:
        coordinator.scheduler.turn()
    with Progress() as bars:
        bars.add_task("job-2", text="")
        sweep.draw(bars, sweep.rows(coordinator))
        assert "job-2" not in {task.description for task in bars.tasks}
