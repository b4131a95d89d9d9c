"""The table of a sweep."""

import io
import math

from rich.console import Console

from rejeu.interrupt import Interrupt
from rejeu.sweeps.coordinator import Coordinator
from rejeu.sweeps.folder import Sweep, open_folder
from rejeu.sweeps.jobs import Code, Job, Options
from rejeu.sweeps.table import Display, closing_lines, remaining
from tests.reporting.test_comparison import write_run
from tests.sweeps.test_coordinator import Launcher


def make(tmp_path):
    """Returns a coordinator in the middle of a sweep: a run is done, one trains, one has failed, one waits."""
    jobs = tuple(Job(name=f"job-{i}", env="CartPole-v1", seed=i, options=Options(steps=1000)) for i in range(4))
    folder = open_folder(tmp_path / "sweep", Sweep(jobs=jobs, threads=1), None, Code())
    write_run(folder.run(jobs[0]), level=100.0)
    folder.write_exit(jobs[0], 0)
    folder.write_exit(jobs[1], 2)
    coordinator = Coordinator(folder, Launcher(capacity=1, ends={"job-2": [None]}), Interrupt(), Code())
    coordinator.turn()
    metrics = "step,time/time_elapsed,rollout/ep_rew_mean\n250,5,20\n500,10,30\n"
    (folder.run(jobs[2]) / "metrics.csv").write_text(metrics, encoding="utf-8")
    return coordinator


def test_states_progress_best_result_and_remaining_time(tmp_path):
    coordinator = make(tmp_path)
    console = Console(file=io.StringIO(), width=150)
    console.print(Display(coordinator.folder).table(coordinator))
    text = console.file.getvalue()
    rows = [line.split() for line in text.splitlines()]
    assert ["job-2", "running", "500", "of", "1,000", "30.00", "-"] in rows
    assert ["job-1", "failed", "0", "of", "1,000", "-", "-"] in rows
    assert ["job-0", "done", "1,000", "of", "1,000", "-", "101.00"] in rows
    assert "1 running, 1 done, 1 failed, 1 waiting, best 101.00 (job-0)" in text
    assert closing_lines(coordinator) == ["4 runs: 1 running, 1 done, 1 failed, 1 waiting"]


def test_the_remaining_time_is_that_of_the_remaining_steps(tmp_path):
    coordinator = make(tmp_path)
    progress = {"job-2": coordinator.folder.progress(coordinator.folder.jobs[2])}
    left = remaining(coordinator, coordinator.outcomes(), progress, {})
    assert left == (2000 - 500) * 10 / 500
    assert math.isnan(remaining(coordinator, coordinator.outcomes(), {}, {}))
