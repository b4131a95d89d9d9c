"""The jobs of a sweep as data, and the folder in which they are trained.

The state of each job follows from its files, so several processes and machines may work on a folder. ::

    sweep.json              the jobs
    plan.toml               copy of the plan
    NAME/                   run folder of a job
    NAME.log                what its processes printed
    compare.html            comparison of the runs
    .sweep/NAME.claim       locked by the process that looks after the job
    .sweep/NAME.run         locked by the process that trains
    .sweep/NAME.exit        exit status of a job that is done (0) or has failed
    .sweep/aside/           run folders that ended before their first checkpoint
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from filelock import FileLock
from msgspec import Meta

from rejeu.checkpoints.run_folder import newest_step
from rejeu.core import atomic
from rejeu.core.errors import CheckpointError
from rejeu.core.records import Malformed, convert, json_text, read_json, shown
from rejeu.core.validation import assign
from rejeu.envs.registry import are_plain
from rejeu.lab.experiments.process import LOST
from rejeu.lab.experiments.scheduler import Work
from rejeu.lab.reporting.runs import EVALUATIONS, METRICS, is_locked
from rejeu.lab.runs.config import RunConfig, Task, written
from rejeu.logs.formatting import quoted
from rejeu.logs.tables import read_bytes, read_table

SWEEP, PLAN, HIDDEN = "sweep.json", "plan.toml", ".sweep"
MAX_BYTES = 2**26
"""Upper limit on the size of a ``sweep.json``."""
PATIENCE = 60.0
"""Seconds to wait while another process creates the folder."""

NOTHING = RunConfig(env="")
"""A command line that names nothing to import."""

MAX_JOBS = 10_000
"""Most runs of a sweep."""
MAX_NAME = 150
"""Most characters of the name of a job, which is also that of a folder."""
UNITS = {"": 1, "B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
Name = Annotated[str, Meta(pattern=rf"^\w[\w.-]{{0,{MAX_NAME - 1}}}\Z")]
FILES = ("no_report", "no_video")
"""Options about the files of a job, which its run does not keep."""


@dataclass(frozen=True, kw_only=True)
class Resources:
    """What one run needs on a node of a Ray cluster; Ray starts no more runs on a node than fit."""

    cpus: Annotated[float, Meta(gt=0, le=10_000)] = 1
    """Processor cores."""
    gpus: Annotated[float, Meta(ge=0, le=1000)] = 0
    """GPUs; a fraction shares one."""
    memory: int | str | None = None
    """Memory in bytes, or as ``"4 GB"``; None reserves none."""
    custom: Annotated[dict[str, Annotated[float, Meta(gt=0)]], Meta(max_length=100)] = field(default_factory=dict)
    """Ray's custom resources by name."""

    def __post_init__(self) -> None:
        assign(self, memory=None if self.memory is None else memory_bytes(self.memory))


def memory_bytes(value: Any) -> int:
    """Returns an amount of memory in bytes.

    Raises:
        ValueError: if it is none.

    >>> memory_bytes("1.5 GB"), memory_bytes(1000)
    (1500000000, 1000)
    """
    found = re.fullmatch(r"(\d{1,15}(?:\.\d{1,6})?) ?([KMGT]?B)?", str(value))
    if isinstance(value, bool) or found is None or float(found[1]) <= 0:
        raise ValueError(f"memory={value!r} must be a number of bytes, or a text such as '4 GB'")
    return int(float(found[1]) * UNITS[found[2] or ""])


@dataclass(frozen=True, kw_only=True)
class Job:
    """One run of a sweep."""

    name: Name
    """Of its folder, its log and its locks."""
    run: RunConfig
    """Its description; what it imports is named on the command line of the sweep."""
    setting: str = ""
    """Name of the hyperparameters."""
    no_report: bool = False
    no_video: bool = False

    def __post_init__(self) -> None:
        if self.run.seed is None:
            raise ValueError(f"the job {self.name} has no seed")
        if self.run.env_argument or self.run.imports:
            raise ValueError(f"the job {self.name} names what is imported, which no file may do")
        if self.run.ray not in (None, "auto"):
            raise ValueError(
                f"ray={self.run.ray!r} must be 'auto': no file may name what is connected to; set RAY_ADDRESS=HOST:PORT"
            )

    @property
    def seed(self) -> int:
        """Seed of the run."""
        assert self.run.seed is not None
        return self.run.seed

    def task(self, folder: Path, resume: bool, imports: tuple[str, ...]) -> Task:
        """Returns what a process is asked to do: to begin the run in a folder, or to continue it there."""
        run = replace(self.run, imports=imports)
        return Task(folder=str(folder), run=run, resume=resume, no_report=self.no_report, no_video=self.no_video)

    def check_code(self, typed: RunConfig, where: object) -> None:
        """Raises ``CheckpointError`` if the job imports something that the command line does not name."""
        kwargs, of_line = ({key: written(one) for key, one in run.env_kwargs.items()} for run in (self.run, typed))
        is_named = self.run.env == typed.env and self.run.wrappers == typed.wrappers and kwargs == (of_line or kwargs)
        if not self.run.names_code or (is_named and (of_line or are_plain(self.run.env_kwargs))):
            return
        options = again([self], RunConfig(env=""))
        raise CheckpointError(
            f"{where} names an environment that is imported or made with more than numbers, which no file may ask for; "
            f"if you trust it, name it again:{options if len(options) < 500 and options.isprintable() else ' --env ENV'}"
        )


def again(jobs: Iterable[Job], typed: RunConfig) -> str:
    """Returns the options with which ``rejeu resume`` imports what jobs need, with a space before each.

    >>> again([Job(name="a", run=RunConfig(env="my_env.py", seed=0))], RunConfig(env="my_env.py"))
    ' --env my_env.py'
    >>> again([Job(name="a", run=RunConfig(env="CartPole-v1", seed=0))], RunConfig(env="", imports=("a.py",)))
    ' --import a.py'
    """
    run = next((job.run for job in jobs if job.run.names_code), RunConfig(env="plain"))
    return replace(run, imports=typed.imports).again()


def job_name(*parts: object) -> str:
    """Returns a readable name for a run and its folder.

    >>> job_name("ALE/Pong-v5", "DQN", "", 3)
    'ALE-Pong-v5-DQN-seed3'
    """
    *labels, seed = parts
    text = "-".join(str(one) for one in labels if one)
    return f"{re.sub(r'[^A-Za-z0-9_.]+', '-', text).strip('-.')[: MAX_NAME - 20]}-seed{seed}"


State = Literal["waiting", "running", "done", "failed", "stopped"]


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """What ``sweep.json`` holds."""

    jobs: Annotated[tuple[Job, ...], Meta(min_length=1, max_length=MAX_JOBS)]
    threads: Annotated[int, Meta(ge=1, le=1024)]
    """Threads of each run. Fixed when the sweep begins, since the last bits of results depend on it."""
    resources: Resources = field(default_factory=Resources)
    schema: Annotated[int, Meta(ge=1, le=1)] = 1


class JobProgress(NamedTuple):
    """Progress of a run, from the ends of its tables."""

    step: int = 0
    seconds: float = float("nan")
    mean_return: float = float("nan")
    best: float = float("nan")
    """Best mean return of an evaluation."""


class JobWork(Work):
    """A job in the folder of a sweep, and its files. Mutable."""

    claim: Path

    def __init__(self, folder: Path, job: Job, imports: tuple[str, ...] = (), is_retried: bool = False) -> None:
        """Starts nothing.

        Args:
            folder: of the sweep.
            job: the job.
            imports: what its process imports first.
            is_retried: whether it is tried again if it has failed before.
        """
        self.folder, self.job, self.imports = folder, job, imports
        self.name, self.run, self.log = job.name, folder / job.name, folder / f"{job.name}.log"
        self.lock, self.claim, self.exit = (folder / HIDDEN / f"{job.name}.{end}" for end in ("run", "claim", "exit"))
        self.is_retried = is_retried and bool(self.exit_status())

    def is_training(self) -> bool:
        """Returns whether a process trains its run, which may outlive the process that started it."""
        return self.lock.is_file() and is_locked(self.lock)

    def exit_status(self) -> int | None:
        """Returns the exit status of a job that is done or has failed; None for another."""
        try:
            return int(read_bytes(self.exit, 20))
        except (OSError, ValueError):
            return None

    def write_exit(self, status: int) -> None:
        """Writes that it is done or has failed."""
        atomic.write(self.exit, f"{status}\n")

    def state(self) -> State:
        """Returns its state, by its files."""
        if self.is_training() or (self.claim.is_file() and is_locked(self.claim)):
            return "running"
        status = self.exit_status()
        if status == 0 and self.has_result():
            return "done"
        if status:
            return "failed"
        return "stopped" if self.run.is_dir() else "waiting"

    def has_result(self) -> bool:
        return (self.run / "agent.safetensors").is_file()

    def is_open(self) -> bool:
        status = self.exit_status()
        return self.is_retried or not (status or (status == 0 and self.has_result()))

    def task(self) -> Task:
        """Returns what trains it on: from its newest checkpoint, else from the start.

        A run folder without a checkpoint is moved aside first.
        """
        self.is_retried = False
        self.exit.unlink(missing_ok=True)
        has_begun = newest_step(self.run / "checkpoints") >= 0
        if not has_begun and self.run.is_dir() and any(self.run.iterdir()):
            self.move_aside()
        return self.job.task(self.run, has_begun, self.imports)

    def move_aside(self) -> None:
        """Moves the run folder out of the way."""
        aside = self.folder / HIDDEN / "aside"
        aside.mkdir(parents=True, exist_ok=True)
        n = 1
        while (target := aside / f"{self.name}-{n}").exists():
            n += 1
        shutil.move(self.run, target)

    def ended(self) -> None:
        """Writes that the job is done or has failed; without it the job is looked at again by the next process."""
        if self.ending == "done":
            self.write_exit(0)
        elif self.ending == "failed":
            self.write_exit(self.status or LOST)

    def progress(self) -> JobProgress:
        """Returns how far its run is."""
        metrics = read_table(self.run / METRICS, ("step", "time/time_elapsed", "rollout/ep_rew_mean"))
        evaluations = read_table(self.run / EVALUATIONS, ("step", "mean_return"))
        values = evaluations.column("mean_return")
        steps = [column[-1] for column in (metrics.column("step"), evaluations.column("step")) if len(column)]
        steps = [one for one in steps if np.isfinite(one)]

        def last(name: str) -> float:
            column = metrics.column(name)
            return float(column[-1]) if len(column) else float("nan")

        best = float(np.nanmax(values)) if np.isfinite(values).any() else float("nan")
        return JobProgress(int(max(steps, default=0)), last("time/time_elapsed"), last("rollout/ep_rew_mean"), best)


class SweepFolder(NamedTuple):
    """The folder of a sweep."""

    path: Path
    sweep: Sweep

    @property
    def jobs(self) -> tuple[Job, ...]:
        """Its jobs, in the order of the plan."""
        return self.sweep.jobs

    def works(self, imports: tuple[str, ...] = (), retry: bool = False) -> list[JobWork]:
        """Returns its jobs as runs that a scheduler trains; ``retry`` tries those again that have failed."""
        return [JobWork(self.path, job, imports, retry) for job in self.jobs]


def is_sweep(path: Path) -> bool:
    """Returns whether a folder is that of a sweep."""
    return (path / SWEEP).is_file()


def open_folder(path: Path, sweep: Sweep, text: str | None, typed: RunConfig) -> SweepFolder:
    """Creates the folder of a sweep, or joins one of the same jobs that exists.

    Args:
        path: the folder.
        sweep: the jobs; an existing folder's number of threads is kept.
        text: of the plan, which is copied.
        typed: what the command line named for import.

    Raises:
        FileExistsError: if the path is a file, or a folder with other things.
        ValueError: if it is the sweep of another plan.
    """
    if path.exists() and not path.is_dir():
        raise FileExistsError(f"{path} is a file; name a folder for the sweep")
    if path.is_dir() and not is_sweep(path) and any(one.name != HIDDEN for one in path.iterdir()):
        raise FileExistsError(f"{path} holds something else than a sweep; name another folder, or remove it first")
    (path / HIDDEN).mkdir(parents=True, exist_ok=True)
    with FileLock(path / HIDDEN / "lock", timeout=PATIENCE):
        if is_sweep(path):
            found = read_folder(path, typed)
            check_same(found, sweep)
            return found
        content = json_text(sweep)
        if text is not None:
            atomic.write(path / PLAN, text)
        atomic.write(path / SWEEP, content)
    return read_folder(path, typed)


def check_same(folder: SweepFolder, sweep: Sweep) -> None:
    """Raises ``ValueError`` if a folder is that of other jobs."""
    if folder.sweep.jobs == sweep.jobs:
        return
    known = {job.name: job for job in folder.jobs}
    given = {job.name: job for job in sweep.jobs}
    differing = next((name for name in [*given, *known] if given.get(name) != known.get(name)), "their order")
    raise ValueError(
        f"{folder.path} is the sweep of another plan: {differing} differs; name another folder with --out, or continue that "
        f"sweep with rejeu resume {quoted(folder.path)}"
    )


def read_folder(path: Path, typed: RunConfig = NOTHING) -> SweepFolder:
    """Returns the folder of an existing sweep. Its file is untrusted.

    Raises:
        FileNotFoundError: if it is none.
        CheckpointError: if it is damaged, or names code that the command line does not.
    """
    if not is_sweep(path):
        raise FileNotFoundError(f"{path} is no folder of a sweep: it holds no {SWEEP}")
    try:
        sweep = convert(read_json(path / SWEEP, MAX_BYTES), Sweep)
        if len({job.name.lower() for job in sweep.jobs}) < len(sweep.jobs):
            raise Malformed("two jobs have the same name")
    except (Malformed, CheckpointError) as error:
        raise CheckpointError(f"{path / SWEEP} is damaged: {shown(error, 1000)}") from None
    for job in sweep.jobs:
        job.check_code(typed, path / SWEEP)
    if not os.access(path, os.W_OK):
        raise PermissionError(f"{path} cannot be written; check its permissions")
    (path / HIDDEN).mkdir(exist_ok=True)
    return SweepFolder(path, sweep)
