"""The folder of a sweep. The state of each job follows from its files, so several processes and machines may work on it.

::

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

import json
import os
import shutil
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from filelock import FileLock
from msgspec import Meta

from rejeu.errors import CheckpointError
from rejeu.experiments.jobs import MAX_JOBS, Job, Resources, from_file
from rejeu.experiments.process import hold
from rejeu.io import atomic
from rejeu.io.records import Malformed, convert, parse_json, shown
from rejeu.reporting.runs import EVALUATIONS, METRICS, is_locked
from rejeu.reporting.tables import read_bytes, read_table
from rejeu.runs.config import RunConfig, Task
from rejeu.runs.folder import newest_step
from rejeu.runs.values import quoted

SWEEP, PLAN, HIDDEN = "sweep.json", "plan.toml", ".sweep"
MAX_BYTES = 2**26
"""Upper limit on the size of a ``sweep.json``."""
PATIENCE = 60.0
"""Seconds to wait while another process creates the folder."""

NOTHING = RunConfig(env="")
"""A command line that names nothing to import."""

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


@dataclass(frozen=True)
class SweepFolder:
    """The files of one sweep."""

    path: Path
    sweep: Sweep

    @property
    def jobs(self) -> tuple[Job, ...]:
        """Its jobs, in the order of the plan."""
        return self.sweep.jobs

    def run(self, job: Job) -> Path:
        """Returns the run folder of a job."""
        return self.path / job.name

    def log(self, job: Job) -> Path:
        """Returns the file with what the processes of a job printed."""
        return self.path / f"{job.name}.log"

    def hidden(self, job: Job, suffix: str) -> Path:
        """Returns a file about a job: ``claim``, ``run`` or ``exit``."""
        return self.path / HIDDEN / f"{job.name}.{suffix}"

    def claim(self, job: Job) -> FileLock | None:
        """Returns the lock of a job, held by this process; None if another process holds it."""
        return hold(self.hidden(job, "claim"))

    def is_training(self, job: Job) -> bool:
        """Returns whether a process trains the run of a job, which may outlive the process that started it."""
        path = self.hidden(job, "run")
        return path.is_file() and is_locked(path)

    def is_held(self, job: Job) -> bool:
        """Returns whether a process looks after a job or trains its run."""
        path = self.hidden(job, "claim")
        return (path.is_file() and is_locked(path)) or self.is_training(job)

    def exit_status(self, job: Job) -> int | None:
        """Returns the exit status of a job that is done or has failed; None for another."""
        try:
            return int(read_bytes(self.hidden(job, "exit"), 20))
        except (OSError, ValueError):
            return None

    def write_exit(self, job: Job, status: int) -> None:
        """Writes that a job is done or has failed."""
        with atomic.replacing(self.hidden(job, "exit")) as file:
            file.write(f"{status}\n".encode())

    def is_done(self, job: Job) -> bool:
        """Returns whether the run of a job reached its goal and its process exited with status 0."""
        return self.exit_status(job) == 0 and (self.run(job) / "agent.safetensors").is_file()

    def state(self, job: Job) -> State:
        """Returns the state of a job."""
        if self.is_held(job):
            return "running"
        if self.is_done(job):
            return "done"
        if self.exit_status(job):
            return "failed"
        return "stopped" if self.run(job).is_dir() else "waiting"

    def task(self, job: Job, imports: tuple[str, ...]) -> Task:
        """Returns what trains a job on: from its newest checkpoint, else from the start.

        A run folder without a checkpoint is moved aside first.
        """
        run = self.run(job)
        has_begun = newest_step(run / "checkpoints") >= 0
        if not has_begun and run.is_dir() and any(run.iterdir()):
            self.move_aside(job)
        return job.task(run, has_begun, imports)

    def move_aside(self, job: Job) -> Path:
        """Moves the run folder of a job out of the way and returns where it is now."""
        aside = self.path / HIDDEN / "aside"
        aside.mkdir(parents=True, exist_ok=True)
        n = 1
        while (target := aside / f"{job.name}-{n}").exists():
            n += 1
        shutil.move(self.run(job), target)
        return target

    def progress(self, job: Job) -> JobProgress:
        """Returns how far the run of a job is."""
        run = self.run(job)
        metrics = read_table(run / METRICS, ("step", "time/time_elapsed", "rollout/ep_rew_mean"))
        evaluations = read_table(run / EVALUATIONS, ("step", "mean_return"))
        values = evaluations.column("mean_return")
        steps = [column[-1] for column in (metrics.column("step"), evaluations.column("step")) if len(column)]
        steps = [one for one in steps if np.isfinite(one)]

        def last(name: str) -> float:
            column = metrics.column(name)
            return float(column[-1]) if len(column) else float("nan")

        best = float(np.nanmax(values)) if np.isfinite(values).any() else float("nan")
        return JobProgress(int(max(steps, default=0)), last("time/time_elapsed"), last("rollout/ep_rew_mean"), best)


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
        content = json.dumps(asdict(sweep), indent=1, allow_nan=False) + "\n"
        if text is not None:
            with atomic.replacing(path / PLAN) as file:
                file.write(text.encode())
        with atomic.replacing(path / SWEEP) as file:
            file.write(content.encode())
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
        data = read_bytes(path / SWEEP, MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise Malformed(f"it has more than {MAX_BYTES:,} bytes")
        content: Any = parse_json(data)
        if isinstance(content, dict) and isinstance(content.get("jobs"), list):
            content["jobs"] = [from_file(job) for job in content["jobs"]]
        sweep = convert(content, Sweep)
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
