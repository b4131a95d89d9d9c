"""The jobs of a sweep as tasks of the scheduler, and their outcomes."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from rejeu.agents import modules_of
from rejeu.experiments.folder import State, SweepFolder
from rejeu.experiments.jobs import Job
from rejeu.experiments.process import LOST
from rejeu.experiments.scheduler import Launcher, Scheduler, Work
from rejeu.interrupt import Interrupt
from rejeu.runs.config import RunConfig
from rejeu.runs.task import Task

STATES = ("running", "done", "failed", "stopped", "waiting")


@dataclass(frozen=True)
class Outcome:
    """The outcome of one job."""

    job: Job
    state: State
    exit_status: int | None
    path: Path
    log: Path


class JobWork(Work):
    """A job of a sweep. Mutable."""

    def __init__(self, folder: SweepFolder, job: Job, imports: tuple[str, ...], is_retried: bool) -> None:
        self.folder, self.job, self.imports = folder, job, imports
        self.is_retried = is_retried
        """Whether it has failed before, and is to be tried again."""
        self.name, self.run, self.log = job.name, folder.run(job), folder.log(job)
        self.lock, self.claim = folder.hidden(job, "run"), folder.hidden(job, "claim")

    def is_open(self) -> bool:
        return self.is_retried or not (self.folder.is_done(self.job) or self.folder.exit_status(self.job))

    def task(self) -> Task:
        self.is_retried = False
        self.folder.hidden(self.job, "exit").unlink(missing_ok=True)
        return self.folder.task(self.job, self.imports)

    def has_result(self) -> bool:
        return (self.run / "agent.safetensors").is_file()

    def ended(self) -> None:
        """Writes that the job is done or has failed; without it the job is looked at again by the next process."""
        if self.ending == "done":
            self.folder.write_exit(self.job, 0)
        elif self.ending == "failed":
            self.folder.write_exit(self.job, self.status or LOST)


class Coordinator:
    """Works through the jobs of a folder until none is left that it may take. Mutable."""

    def __init__(
        self,
        folder: SweepFolder,
        launcher: Launcher,
        stop: Interrupt,
        typed: RunConfig,
        retry: bool = False,
        say: Callable[[str], object] = lambda text: None,
    ) -> None:
        """Starts nothing yet.

        Args:
            folder: of the sweep.
            launcher: what starts runs.
            stop: a requested stop ends all runs, with checkpoints.
            typed: what the command line named for import.
            retry: whether jobs that have failed are tried again, once.
            say: called with a line for each event.

        Raises:
            ValueError: if the processes of the runs could not find an algorithm.
        """
        algorithms = {job.run.algorithm: None for job in folder.jobs if job.run.algorithm is not None}
        modules = {name: None for algorithm in algorithms for name in modules_of(algorithm, typed.imports)}
        self.folder, self.launcher = folder, launcher
        self.typed = dataclasses.replace(typed, imports=tuple(modules) or typed.imports)
        self.tasks = [
            JobWork(folder, job, self.typed.imports, retry and bool(folder.exit_status(job))) for job in folder.jobs
        ]
        self.scheduler = Scheduler(launcher, stop, say)
        self.scheduler.waiting.extend(task for task in self.tasks if task.is_open())

    def run(self, watch: Callable[[Coordinator], None] = lambda coordinator: None) -> None:
        """Works until nothing is left; ``watch`` is called several times a second."""
        self.scheduler.run(lambda: watch(self))

    def running(self) -> list[Job]:
        """Returns the jobs that this process looks after and that train."""
        attended = {attempt.task for attempt in self.scheduler.running}
        return [task.job for task in self.tasks if task in attended]

    def outcomes(self) -> list[Outcome]:
        """Returns the state of every job."""
        folder, running = self.folder, {job.name for job in self.running()}
        return [
            Outcome(
                task.job,
                "running" if task.name in running else folder.state(task.job),
                folder.exit_status(task.job) if task.status is None else task.status,
                task.run,
                task.log,
            )
            for task in self.tasks
        ]


def count(states: Iterable[str]) -> dict[str, int]:
    """Returns how often each state occurs.

    >>> count(["done", "failed", "done"])
    {'running': 0, 'done': 2, 'failed': 1, 'stopped': 0, 'waiting': 0}
    """
    return dict.fromkeys(STATES, 0) | Counter(states)
