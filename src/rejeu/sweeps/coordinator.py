"""Schedules the jobs of a sweep: which run starts when, and how its exit status is handled."""

from __future__ import annotations

import dataclasses
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from filelock import FileLock

from rejeu.agents import modules_of
from rejeu.interrupt import Interrupt
from rejeu.reporting.text import quoted
from rejeu.supervised import TAKEN
from rejeu.sweeps.folder import State, SweepFolder
from rejeu.sweeps.jobs import Code, Job, again
from rejeu.sweeps.process import LOST, last_line

POLL = 0.2
"""Seconds between two looks at the processes."""
RESCAN = 2.0
"""Seconds between two attempts to take jobs that another process holds."""
MAX_LOST = 5
"""How often in a row a run may be lost without a new checkpoint before it counts as failed."""
STOPPED = (129, 130, 143)
"""Exit statuses of a run that a signal stopped; its checkpoint is saved."""


class Handle(Protocol):
    """A run that was started."""

    def poll(self) -> int | None:
        """Returns the exit status, negative if the process was lost; None while it runs."""

    def stop(self) -> None:
        """Asks it to stop after the current step, with a checkpoint."""


class Launcher(Protocol):
    """What starts runs."""

    @property
    def capacity(self) -> int:
        """Runs at once; may change."""

    def start(self, words: Sequence[str], run: Path, log: Path, lock: Path) -> Handle:
        """Starts a run with the command line ``rejeu WORDS``."""

    def close(self) -> None:
        """Ends what it started."""


@dataclass
class Attempt:
    """A job that this process looks after, and its run. Mutable."""

    job: Job
    claim: FileLock
    handle: Handle
    first_step: int
    """Step of the checkpoint that it began from, -1 for none."""
    began: float


@dataclass(frozen=True)
class Outcome:
    """The outcome of one job."""

    job: Job
    state: State
    exit_status: int | None
    path: Path
    log: Path


class Coordinator:
    """Works through the jobs of a folder until none is left that it may take. Mutable."""

    def __init__(
        self,
        folder: SweepFolder,
        launcher: Launcher,
        stop: Interrupt,
        code: Code,
        retry: bool = False,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Starts nothing yet.

        Args:
            folder: of the sweep.
            launcher: what starts runs.
            stop: a requested stop ends all runs, with checkpoints.
            code: what runs import.
            retry: whether jobs that have failed are tried again, once.
            say: called with a line for each event.

        Raises:
            ValueError: if the processes of the runs could not find an algorithm.
        """
        algorithms = {job.algorithm: None for job in folder.jobs if job.algorithm is not None}
        modules = {name: None for algorithm in algorithms for name in modules_of(algorithm, code.imports)}
        self.folder, self.launcher, self.stop, self.say = folder, launcher, stop, say
        self.code = dataclasses.replace(code, imports=tuple(modules) or code.imports)
        self.running: list[Attempt] = []
        self.retried = {job.name for job in folder.jobs if folder.exit_status(job)} if retry else set[str]()
        """Names of failed jobs that are still to be tried again."""
        self.waiting = deque(job for job in folder.jobs if self._is_open(job))
        """Jobs that this process may still take."""
        self.lost: dict[str, int] = {}
        """How often in a row the run of a job was lost without a new checkpoint."""
        self.statuses: dict[str, int] = {}
        """Last exit status of the jobs that this process looked after."""
        self._rescan_at = 0.0
        self._passes = 0
        self._is_stopping = False

    def run(self, watch: Callable[[Coordinator], None] = lambda coordinator: None) -> None:
        """Works until nothing is left; ``watch`` is called several times a second."""
        try:
            while self.turn():
                watch(self)
                time.sleep(POLL)
            watch(self)
        finally:
            for attempt in self.running:
                attempt.handle.stop()
                attempt.claim.release()
            self.launcher.close()

    def turn(self) -> bool:
        """Handles the runs that have ended, starts those that fit, and returns whether there is more to do."""
        for attempt in [*self.running]:
            status = attempt.handle.poll()
            if status is not None:
                self._end(attempt, status)
        if self.stop.requested and not self._is_stopping:
            self._is_stopping = True
            self.waiting.clear()
            for attempt in self.running:
                attempt.handle.stop()
        if self.waiting and len(self.running) < self.launcher.capacity and time.monotonic() >= self._rescan_at:
            self._start_some()
        return bool(self.running or self.waiting)

    def _is_open(self, job: Job) -> bool:
        """Returns whether a job is neither done nor has failed."""
        return job.name in self.retried or not (self.folder.is_done(job) or self.folder.exit_status(job))

    def _start_some(self) -> None:
        """Starts runs until there is no capacity left, or no job that nobody else holds."""
        held: list[Job] = []
        while self.waiting and len(self.running) < self.launcher.capacity:
            job = self.waiting.popleft()
            try:
                claim = self.folder.claim(job)
            except OSError as error:
                self._say_not_started(job, error)
                continue
            if claim is None or self.folder.is_training(job):
                held.append(job)
            elif self._is_open(job):
                self._start(job, claim)
                continue
            if claim is not None:
                claim.release()
        self.waiting.extendleft(reversed(held))
        if held:
            self._rescan_at = time.monotonic() + RESCAN
        self._passes = self._passes + 1 if held and not self.running else 0
        if self._passes > 1 and not any(self.folder.is_training(job) and self._is_abandoned(job) for job in held):
            self.waiting.clear()  # others look after all of them

    def _is_abandoned(self, job: Job) -> bool:
        """Returns whether nobody looks after a job, although its run may still be ending."""
        claim = self.folder.claim(job)
        if claim is not None:
            claim.release()
        return claim is not None

    def _start(self, job: Job, claim: FileLock) -> None:
        """Starts the run of a job, from its newest checkpoint if there is one."""
        folder = self.folder
        self.retried.discard(job.name)
        try:
            folder.hidden(job, "exit").unlink(missing_ok=True)
            first = folder.step(job)
            words = folder.words(job, self.code)
            handle = self.launcher.start(words, folder.run(job), folder.log(job), folder.hidden(job, "run"))
        except OSError as error:
            claim.release()
            self.statuses[job.name] = 2
            self._note_exit(job, 2)
            self._say_not_started(job, error)
            return
        self.running.append(Attempt(job, claim, handle, first, time.monotonic()))

    def _say_not_started(self, job: Job, error: OSError) -> None:
        self.say(
            f"{job.name} could not be started: {' '.join(str(error).split())}; "
            f"rejeu resume {quoted(self.folder.path)}{again([job], self.code)} tries again"
        )

    def _end(self, attempt: Attempt, status: int) -> None:
        """Records how a run ended: it is done, has failed, was stopped, or was lost and continues later."""
        job, folder = attempt.job, self.folder
        self.running.remove(attempt)
        self.statuses[job.name] = status
        try:
            if status == 0:
                self._note_exit(job, 0)
                self.say(f"{job.name}: done")
            elif self._is_stopping and (status < 0 or status in STOPPED):
                self.say(f"{job.name}: stopped")
            elif status < 0 or status in (*STOPPED, TAKEN):
                self._go_on_later(attempt, status)
            else:
                self._fail(job, status, f"failed with exit status {status}: {last_line(folder.log(job))}")
        finally:
            attempt.claim.release()

    def _go_on_later(self, attempt: Attempt, status: int) -> None:
        """Puts a lost run back, unless it was lost too often."""
        job, step = attempt.job, self.folder.step(attempt.job)
        self.lost[job.name] = 0 if step > attempt.first_step else self.lost.get(job.name, 0) + 1
        if self.lost[job.name] >= MAX_LOST:
            self._fail(
                job, status, f"was lost {MAX_LOST} times in a row without a new checkpoint (exit status {status})"
            )
            return
        how = f"continues from step {step:,}" if step >= 0 else "starts from the beginning"
        self.say(f"{job.name} was lost (exit status {status}); it {how}")
        self.waiting.appendleft(job)

    def _fail(self, job: Job, status: int, text: str) -> None:
        self._note_exit(job, status if status != 0 else LOST)
        self.say(f"{job.name} {text} (log {self.folder.log(job)})")

    def _note_exit(self, job: Job, status: int) -> None:
        """Writes the exit status of a job, or says why not; without it the job is looked at again by the next process."""
        try:
            self.folder.write_exit(job, status)
        except OSError as error:
            self.say(f"{job.name} ended with exit status {status}, but {error}")

    def outcomes(self) -> list[Outcome]:
        """Returns the state of every job."""
        folder = self.folder
        attended = {attempt.job.name for attempt in self.running}
        return [
            Outcome(
                job,
                "running" if job.name in attended else folder.state(job),
                self.statuses.get(job.name, folder.exit_status(job)),
                folder.run(job),
                folder.log(job),
            )
            for job in folder.jobs
        ]


def count(states: Iterable[str]) -> dict[str, int]:
    """Returns how often each state occurs.

    >>> count(["done", "failed", "done"])
    {'running': 0, 'done': 2, 'failed': 1, 'stopped': 0, 'waiting': 0}
    """
    found = dict.fromkeys(("running", "done", "failed", "stopped", "waiting"), 0)
    for one in states:
        found[one] += 1
    return found
