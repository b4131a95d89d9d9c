"""A run of an experiment: its description, its files, and what the scheduler needs to know of it.

The state of a run follows from its files, so several processes and machines may work on a folder. ::

    NAME/                   run folder
    NAME.log                what its processes printed
    .sweep/NAME.claim       locked by the process that looks after the run
    .sweep/NAME.exit        exit status of a run that is done (0) or has failed
    .sweep/aside/           run folders that ended before their first checkpoint
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from rejeu.checkpoints.run_folder import RunFolder, newest_step
from rejeu.core import atomic
from rejeu.envs.registry import are_plain
from rejeu.lab.runs.config import RunConfig, Task, written
from rejeu.lab.runs.process import LOST
from rejeu.lab.runs.read import is_locked
from rejeu.logs.tables import read_bytes

HIDDEN = ".sweep"
MAX_NAME = 150
"""Most characters of the name of a job, which is also that of a folder."""
Name = Annotated[str, Meta(pattern=rf"^\w[\w.-]{{0,{MAX_NAME - 1}}}\Z")]
FILES = ("no_report", "no_video")
"""Options about the files of a job, which its run does not keep."""
State = Literal["waiting", "running", "done", "failed", "stopped"]
Ending = Literal["done", "failed", "stopped", "left"]


@dataclass(frozen=True, kw_only=True)
class Job:
    """One run of an experiment."""

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

    @property
    def label(self) -> str:
        """Its name in messages."""
        return f"seed {self.seed}" if self.name == f"seed_{self.seed}" else self.name

    def task(self, folder: Path, resume: bool, imports: tuple[str, ...]) -> Task:
        """Returns the task of a process: to begin the run in a folder, or to continue it there."""
        run = replace(self.run, imports=imports)
        return Task(folder=str(folder), run=run, resume=resume, no_report=self.no_report, no_video=self.no_video)

    def check_code(self, typed: RunConfig, where: object) -> None:
        """Raises ``CheckpointError`` if the job imports something that the command line does not name."""
        kwargs, of_line = ({key: written(value) for key, value in run.env_kwargs.items()} for run in (self.run, typed))
        is_named = self.run.env == typed.env and self.run.wrappers == typed.wrappers and kwargs == (of_line or kwargs)
        if self.run.names_code and not (is_named and (of_line or are_plain(self.run.env_kwargs))):
            raise self.run.refusal(where)


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
    text = "-".join(str(label) for label in labels if label)
    return f"{re.sub(r'[^A-Za-z0-9_.]+', '-', text).strip('-.')[: MAX_NAME - 20]}-seed{seed}"


class Work:
    """A job in the folder of an experiment, its files, and what has become of it. Mutable."""

    ending: Ending | None = None
    """How it ended, None before."""
    status: int | None = None
    """Its last exit status."""
    reason: str = ""
    """Why it failed or was left."""

    def __init__(
        self,
        folder: Path,
        job: Job,
        imports: tuple[str, ...] = (),
        is_retried: bool = False,
        name: str = "",
        keeps_checkpoints: bool = True,
    ) -> None:
        """Starts nothing.

        Args:
            folder: of the experiment.
            job: the job.
            imports: what its process imports first.
            is_retried: whether it is tried again if it has failed before.
            name: for messages; by default that of the job.
            keeps_checkpoints: whether its checkpoints, which hold the replay buffer, are kept once it is done.
        """
        self.folder, self.job, self.imports, self.keeps_checkpoints = folder, job, imports, keeps_checkpoints
        self.name, self.path, self.log = name or job.label, folder / job.name, folder / f"{job.name}.log"
        self.files = RunFolder(self.path)
        self.claim, self.exit = (folder / HIDDEN / f"{job.name}.{end}" for end in ("claim", "exit"))
        self.is_retried = is_retried and bool(self.exit_status())

    def is_training(self) -> bool:
        """Returns whether a process trains its run, which may outlive the process that started it."""
        return is_locked(self.files.lock)

    def exit_status(self) -> int | None:
        """Returns the exit status of a job that is done or has failed; None for another."""
        try:
            return int(read_bytes(self.exit, 20))
        except (OSError, ValueError):
            return None

    def write_exit(self, status: int) -> None:
        """Writes that it is done or has failed."""
        atomic.write(self.exit, f"{status}\n")

    @property
    def state(self) -> State:
        """Its state, by its files."""
        if self.is_training() or is_locked(self.claim):
            return "running"
        status = self.exit_status()
        if status == 0 and self.has_result():
            return "done"
        if status:
            return "failed"
        return "stopped" if self.path.is_dir() else "waiting"

    def has_result(self) -> bool:
        """Returns whether its files contain what it was trained for."""
        return self.files.agent.is_file()

    def is_open(self) -> bool:
        """Returns whether there is something left to train; also asked after the claim was obtained."""
        status = self.exit_status()
        return self.is_retried or not (status or (status == 0 and self.has_result()))

    def task(self) -> Task:
        """Returns the task that trains it on: from its newest checkpoint, else from the start.

        A run folder without a checkpoint is moved aside first.
        """
        self.is_retried = False
        self.exit.unlink(missing_ok=True)
        has_begun = newest_step(self.files.checkpoints) >= 0
        if not has_begun and self.path.is_dir() and any(self.path.iterdir()):
            self.move_aside()
        return self.job.task(self.path, has_begun, self.imports)

    def move_aside(self) -> None:
        """Moves the run folder out of the way."""
        aside = self.folder / HIDDEN / "aside"
        aside.mkdir(parents=True, exist_ok=True)
        n = 1
        while (target := aside / f"{self.job.name}-{n}").exists():
            n += 1
        shutil.move(self.path, target)

    def ended(self) -> None:
        """Writes that the job is done or has failed; without it the job is looked at again by the next process."""
        if self.ending == "done":
            self.write_exit(0)
            if not self.keeps_checkpoints:
                self.drop_checkpoints()
        elif self.ending == "failed":
            self.write_exit(self.status or LOST)

    def drop_checkpoints(self) -> None:
        """Deletes its checkpoints."""
        shutil.rmtree(self.files.checkpoints, ignore_errors=True)
