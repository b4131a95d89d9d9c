"""The order of runs, and what their ends mean, with runs that are only pretended; and the states of jobs."""

import dataclasses
import json
from pathlib import Path

import pytest
from filelock import FileLock

from rejeu.agents import AGENTS, SAC
from rejeu.core.errors import CheckpointError
from rejeu.core.interrupt import Interrupt
from rejeu.lab.experiments import scheduler
from rejeu.lab.experiments.folder import Plan, open_folder, read_folder
from rejeu.lab.experiments.scheduler import MAX_LOST, Scheduler
from rejeu.lab.experiments.sweep import imports_of
from rejeu.lab.experiments.work import Job, Work
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.runs.process import hold

NOTHING = RunConfig(env="")
"""A command line that names nothing to import."""


class Handle:
    """A run that ends with the given status after some looks at it."""

    def __init__(self, launcher, run, status):
        self.launcher, self.run, self.status, self.looks = launcher, run, status, 2

    def poll(self):
        self.looks -= 1
        if self.looks > 0 or self.status is None:
            return None
        if self.status == 0 and self.launcher.results:
            (self.run / "agent.safetensors").touch()
        return self.status

    def stop(self):
        self.status = 143 if self.status is None else self.status


class Launcher:
    """Pretends to train. ``ends`` has the exit statuses of the runs by name, in order; 0 where it has none."""

    def __init__(self, capacity=2, ends=(), checkpoints=True, results=True):
        self.results = results
        self.capacity, self.ends, self.checkpoints = (
            capacity,
            {key: [*value] for key, value in dict(ends).items()},
            checkpoints,
        )
        self.started = []
        self.most = 0
        self.handles = []

    def start(self, task, log):
        content = json.loads(task.read_text())
        run = Path(content["folder"])
        self.started.append(("resume" if content["resume"] else "train", run.name))
        run.mkdir(exist_ok=True)
        (run / "config.json").touch()
        if self.checkpoints:
            (run / "checkpoints").mkdir(exist_ok=True)
            count = len(list((run / "checkpoints").iterdir()))
            (run / "checkpoints" / f"run_{count:012d}.safetensors").touch()
        log.write_text("the reason\n", encoding="utf-8")
        ends = self.ends.get(run.name)
        handle = Handle(self, run, ends.pop(0) if ends else 0)
        self.handles.append(handle)
        self.most = max(self.most, sum(one.looks > 0 for one in self.handles))
        return handle

    def close(self):
        pass


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(scheduler, "POLL", 0)
    monkeypatch.setattr(scheduler, "RESCAN", 0)


def make_jobs(n=4, **more):
    return tuple(Job(name=f"job-{i}", run=RunConfig(env="CartPole-v1", seed=i, **more)) for i in range(n))


def test_an_algorithm_that_no_other_process_knows_is_refused(tmp_path, monkeypatch):
    folder = open_folder(tmp_path / "sweep", Plan(jobs=make_jobs(2, algorithm="Own"), threads=1), None, NOTHING)
    with pytest.raises(ValueError, match="no algorithm is called 'Own'"):
        imports_of(folder, NOTHING)
    monkeypatch.setitem(AGENTS, "Own", type("Own", (SAC,), {}))
    with pytest.raises(ValueError, match=r"Own is registered in this program only.*imports=\['my_algorithm.py'\]"):
        imports_of(folder, NOTHING)
    assert imports_of(folder, RunConfig(env="", imports=("own.py",))) == ("own.py",)


def make_folder(tmp_path, n=4):
    return open_folder(tmp_path / "sweep", Plan(jobs=make_jobs(n), threads=1), None, NOTHING)


def work(folder, launcher, watch=lambda: None, retry=False, stop=None):
    lines = []
    one = Scheduler(launcher, stop or Interrupt(), lines.append)
    one.add(folder.works(retry=retry))
    one.run(watch)
    return {one.job.name: one.state for one in one.works}, lines


def test_every_job_is_trained_once_and_not_more_than_fit_at_once(tmp_path, monkeypatch):
    folder, launcher, claims = make_folder(tmp_path), Launcher(capacity=2, ends={"job-3": [-9, 0]}), []
    monkeypatch.setattr(scheduler, "hold", lambda path: (claims.append(hold(path)), claims[-1])[1])
    states, _ = work(folder, launcher)
    assert len(claims) == 5
    assert not any(claim.is_locked for claim in claims)
    assert set(states.values()) == {"done"}
    assert sorted(launcher.started) == [("resume", "job-3"), *(("train", f"job-{i}") for i in range(4))]
    assert launcher.most <= 2
    again = Launcher()
    work(folder, again, retry=True)
    assert again.started == []


def test_a_failed_run_does_not_stop_the_others_and_only_resume_repeats_it(tmp_path):
    folder, launcher = make_folder(tmp_path), Launcher(ends={"job-1": [2]})
    states, lines = work(folder, launcher)
    assert states == {"job-0": "done", "job-1": "failed", "job-2": "done", "job-3": "done"}
    assert any("job-1 failed with exit status 2: the reason" in line for line in lines)
    joined = Launcher()
    work(folder, joined)
    assert joined.started == []
    assert folder.works(("a.py",))[1].task().run.imports == ("a.py",)
    assert folder.works()[1].exit_status() is None  # that of the attempt before
    folder.works()[1].write_exit(2)
    resumed = Launcher(ends={"job-1": [2]})
    states, _ = work(folder, resumed, retry=True)
    assert resumed.started == [("resume", "job-1")]
    assert states["job-1"] == "failed"


def test_a_run_whose_model_is_gone_is_not_done_and_is_trained_again(tmp_path):
    folder = make_folder(tmp_path, 2)
    work(folder, Launcher())
    of_first = folder.works()[0]
    of_first.files.agent.unlink()
    assert [one.state for one in folder.works()] == ["stopped", "done"]
    again = Launcher()
    work(folder, again)
    assert [name for _, name in again.started] == ["job-0"]


@pytest.mark.parametrize("status", [-9, 143, 75])
def test_a_lost_run_continues_from_its_checkpoint_or_starts_anew_and_its_files_are_kept(tmp_path, status):
    folder, launcher = make_folder(tmp_path, 1), Launcher(ends={"job-0": [status, status, 0]})
    states, lines = work(folder, launcher)
    assert launcher.started == [("train", "job-0"), ("resume", "job-0"), ("resume", "job-0")]
    assert states == {"job-0": "done"}
    assert "continues from step" in lines[0]
    folder, launcher = make_folder(tmp_path / "b", 1), Launcher(ends={"job-0": [status, 0]}, checkpoints=False)
    states, _ = work(folder, launcher)
    assert launcher.started == [("train", "job-0"), ("train", "job-0")]
    assert states == {"job-0": "done"}
    assert (folder.path / ".sweep" / "aside" / "job-0-1" / "config.json").is_file()


def test_a_run_that_is_lost_again_and_again_without_progress_fails(tmp_path):
    folder, launcher = make_folder(tmp_path, 1), Launcher(ends={"job-0": [-9] * 20}, checkpoints=False)
    states, lines = work(folder, launcher)
    assert states == {"job-0": "failed"}
    assert len(launcher.started) == MAX_LOST
    assert "without a new checkpoint" in lines[-1]


def test_a_run_that_ends_without_a_result_fails_with_one_line(tmp_path):
    folder, launcher = make_folder(tmp_path, 2), Launcher(results=False)
    states, lines = work(folder, launcher)
    assert states == {"job-0": "failed", "job-1": "failed"}
    assert len(lines) == len(launcher.started) == 2
    assert all("ended without a result" in line for line in lines)


def test_a_stop_ends_all_runs_and_starts_no_more(tmp_path):
    folder, launcher, stop = make_folder(tmp_path), Launcher(ends={f"job-{i}": [None] for i in range(4)}), Interrupt()

    def watch():
        stop.signal = 2

    states, _ = work(folder, launcher, watch, stop=stop)
    assert states == {"job-0": "stopped", "job-1": "stopped", "job-2": "waiting", "job-3": "waiting"}
    more = Launcher()
    states, _ = work(folder, more)
    assert set(states.values()) == {"done"}
    assert more.started[:2] == [("resume", "job-0"), ("resume", "job-1")]


def test_jobs_that_another_process_holds_are_left_to_it(tmp_path):
    folder = make_folder(tmp_path)
    held = folder.works()[1]
    claim = hold(held.claim)
    assert claim is not None
    assert hold(held.claim) is None
    launcher = Launcher()
    states, _ = work(folder, launcher)
    assert states == {"job-0": "done", "job-1": "running", "job-2": "done", "job-3": "done"}
    claim.release()
    assert held.state == "waiting"


@pytest.mark.parametrize("where", ["start", "claimed"])
def test_a_run_that_cannot_be_started_is_one_line_and_stops_no_other(tmp_path, monkeypatch, where):
    folder, launcher = make_folder(tmp_path, 2), Launcher()

    def full(*given):
        if "job-0" in str(getattr(given[0], "name", given[0])):
            raise OSError(28, "No space left on device")
        return real(*given)

    owner = launcher if where == "start" else scheduler
    real = getattr(owner, where)
    with monkeypatch.context() as patch:
        patch.setattr(owner, where, full)
        states, lines = work(folder, launcher)
    assert states == {"job-0": "waiting", "job-1": "done"}  # left to a later process
    assert lines[0] == "job-0 could not be started: [Errno 28] No space left on device"
    assert folder.works()[0].exit_status() is None
    states, _ = work(folder, launcher)
    assert states == {"job-0": "done", "job-1": "done"}


def test_a_full_disk_at_the_end_of_a_run_is_one_line(tmp_path, monkeypatch):
    folder = make_folder(tmp_path, 1)

    def full(self, status):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Work, "write_exit", full)
    states, lines = work(folder, Launcher())
    assert "job-0 ended with exit status 0, but [Errno 28] No space left" in lines[-1]
    assert states == {"job-0": "stopped"}  # the next process finds its last checkpoint


def test_a_folder_is_joined_only_with_the_same_plan(tmp_path):
    folder = make_folder(tmp_path)
    assert make_folder(tmp_path).plan == folder.plan
    joined = open_folder(folder.path, Plan(jobs=folder.plan.jobs, threads=7), None, NOTHING)
    assert joined.plan.threads == 1  # fixed when it began
    other = Plan(jobs=make_jobs(4, hyperparameters={"gamma": 0.9}), threads=1)
    with pytest.raises(ValueError, match="is the sweep of another plan: job-0 differs"):
        open_folder(folder.path, other, None, NOTHING)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").touch()
    with pytest.raises(FileExistsError, match="something else"):
        open_folder(tmp_path / "other", folder.plan, None, NOTHING)


@pytest.mark.parametrize(
    ("key", "value", "problem"),
    [
        ("name", "../x", "jobs[0].name"),
        ("name", "job-1", "same name"),
        ("hyperparameters", {"a --import os": 1}, ""),
        ("minutes", 10**400, "out of range"),
        ("ray", "evil.org:6379", "no file may name what is connected to; set RAY_ADDRESS"),
        ("env", "evil:Env-v0", "name it again: --env evil:Env-v0"),
        ("wrappers", ["evil:Wrapper"], "--wrapper evil:Wrapper"),
        ("env_kwargs", {"path": "/etc/passwd"}, "imported or made with more than numbers"),
        ("env_kwargs", {"render_mode": "rgb_array", "--import": "evil.py"}, "env_kwargs"),
        ("imports", ["evil.py"], "names what is imported"),
        ("seed", None, "has no seed"),
    ],
)
def test_the_file_of_a_sweep_is_untrusted(tmp_path, key, value, problem):
    folder = make_folder(tmp_path)
    path = folder.path / "sweep.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    job = content["jobs"][0]
    (job if key in job else job["run"]).update({key: value})
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(CheckpointError) as raised:
        read_folder(folder.path, NOTHING)
    assert problem in str(raised.value)
    assert "\n" not in str(raised.value)


def test_keyword_arguments_that_no_file_may_give_are_typed_again():
    job = Job(name="a", run=RunConfig(env="Walk-v0", seed=0, env_kwargs={"model": "/tmp/walk.xml"}))
    typed = RunConfig(env="Walk-v0")
    for one in (NOTHING, typed, dataclasses.replace(typed, env_kwargs={"model": "other.xml"})):
        with pytest.raises(CheckpointError, match=r"--env Walk-v0 --env-kwargs model=/tmp/walk\.xml"):
            job.check_code(one, "x")
    job.check_code(dataclasses.replace(typed, env_kwargs=dict(job.run.env_kwargs)), "x")


def test_code_that_the_command_line_names_again_is_trusted(tmp_path):
    run = RunConfig(env="my_env:Walk-v0", seed=0, wrappers=("my_env:Shaped",), env_kwargs={"g": 9.8})
    job = Job(name="a", run=run)
    with pytest.raises(CheckpointError):
        job.check_code(dataclasses.replace(run, env="other:Walk-v0"), "x")
    job.check_code(run, "x")
    task = job.task(tmp_path, True, ("more",))
    assert task.run == dataclasses.replace(run, imports=("more",))
    assert (task.resume, task.folder) == (True, str(tmp_path))


def test_a_run_waits_for_a_process_that_still_ends(tmp_path):
    folder, launcher = make_folder(tmp_path, 1), Launcher()
    (work,) = folder.works()
    work.files.checkpoints.mkdir(parents=True)
    orphan = FileLock(work.files.lock)  # of a process that outlived the one that started it
    orphan.acquire()
    looks = iter(range(100))

    def watch():
        if next(looks) == 6:
            assert launcher.started == []
            orphan.release()

    one = Scheduler(launcher, Interrupt())
    one.add([work])
    one.run(watch)
    assert work.ending == "done"
