"""The scheduler of all runs that are processes: which starts when, and what its end means.

Sweeps, several seeds, studies and their final comparisons give it their runs: all at the start, or, by a policy, some at
each turn. One rule holds for all of them:

- A run that ends with status 0 is done if it left its result; otherwise it has failed.
- A run that was lost (its process was killed, its machine is gone, it was stopped by somebody else) continues from its newest
  checkpoint. It has failed if it is lost ``MAX_LOST`` times in a row without a new checkpoint.
- A run with another status has failed.
- A run that cannot be started, as on a full disk, has not failed: it is left to a later process.
- When this process is asked to stop, all runs stop with a checkpoint, and continue when they are scheduled again.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from filelock import FileLock

from rejeu.checkpoints.run_folder import newest_step
from rejeu.core.interrupt import TAKEN, Interrupt
from rejeu.lab.experiments.process import hold, last_line
from rejeu.lab.experiments.work import Ending, Work
from rejeu.lab.runs.config import write_task
from rejeu.lab.runs.read import is_locked

POLL = 0.2
"""Seconds between two looks at the processes."""
RESCAN = 2.0
"""Seconds between two attempts to take runs that another process holds."""
MAX_LOST = 5
"""How often in a row a run may be lost without a new checkpoint before it counts as failed."""
STOPPED = (129, 130, 143)
"""Exit statuses of a run that a signal stopped; its checkpoint is saved."""

Say = Callable[[str], object]
Policy = Callable[[], bool]
"""Which runs train next, given the results: adds some, asks others to stop, and returns whether it may add more."""


class Handle(Protocol):
    """A run that was started."""

    def poll(self) -> int | None:
        """Returns the exit status, negative if the process was lost; None while it runs."""

    def stop(self) -> None:
        """Asks it to stop after the current step, with a checkpoint."""


class Launcher(Protocol):
    """What starts runs: processes of this machine, or tasks on a cluster."""

    @property
    def capacity(self) -> int:
        """Runs at once; may change."""

    def start(self, task: Path, log: Path, lock: Path) -> Handle:
        """Starts a run with the command line ``rejeu --task FILE``."""

    def close(self) -> None:
        """Ends what it started."""


@dataclass(eq=False)
class Attempt:
    """A task whose process runs. Mutable."""

    task: Work
    claim: FileLock
    handle: Handle
    first_step: int
    """Step of the checkpoint that it began from, -1 for none."""
    asked: bool = False
    """Whether it was asked to stop."""


class Scheduler:
    """Works through tasks until none is left that this process may take. Mutable."""

    def __init__(self, launcher: Launcher, stop: Interrupt, say: Say = lambda text: None, waits: bool = False) -> None:
        """Starts nothing yet.

        Args:
            launcher: what starts runs.
            stop: a requested stop ends all runs, with checkpoints.
            say: called with a line for each event.
            waits: whether to wait for tasks that other processes have claimed, rather than to leave them to these.
        """
        self.launcher, self.stop, self.say, self.waits = launcher, stop, say, waits
        self.works: list[Work] = []
        """All that were added."""
        self.waiting: deque[Work] = deque()
        """Tasks that this process may still take."""
        self.running: list[Attempt] = []
        self._lost: dict[Work, int] = {}
        """How often in a row a task was lost without a new checkpoint."""
        self._rescan_at = 0.0
        self._passes = 0
        """How often in a row every waiting task was held by another process."""

    def add(self, works: Iterable[Work]) -> None:
        """Adds runs, in this order."""
        for work in works:
            self.works.append(work)
            if self._is_open(work):
                self.waiting.append(work)

    @property
    def left(self) -> list[str]:
        """The runs that could not be started, each with the reason."""
        return [f"{work.name} {work.reason}" for work in self.works if work.ending == "left"]

    def run(self, watch: Callable[[], object] = lambda: None, policy: Policy = lambda: False) -> None:
        """Works until nothing is left; ``watch`` and ``policy`` are called several times a second."""
        try:
            while policy() | self.turn():
                watch()
                time.sleep(POLL)
            watch()
        finally:
            self.close()

    def close(self) -> None:
        """Lets all runs stop by themselves, with a checkpoint."""
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
        if self.stop.requested:
            self.ask_to_stop(*self.waiting, *(attempt.task for attempt in self.running))
        if self.waiting and len(self.running) < self.launcher.capacity and time.monotonic() >= self._rescan_at:
            self._start_some()
        return bool(self.running or self.waiting)

    def ask_to_stop(self, *tasks: Work) -> None:
        """Asks runs to stop with a checkpoint, and forgets those that wait."""
        for task in tasks:
            if task in self.waiting:
                self.waiting.remove(task)
                task.ending = "stopped"
        for attempt in self.running:
            if attempt.task in tasks and not attempt.asked:
                attempt.asked = True
                attempt.handle.stop()

    def _start_some(self) -> None:
        """Starts tasks until there is no capacity left, or no task that nobody else holds."""
        held: list[Work] = []
        while self.waiting and len(self.running) < self.launcher.capacity:
            task = self.waiting.popleft()
            try:
                claim = claimed(task)
            except OSError as error:
                self._leave(task, error)
                continue
            if claim is None:
                held.append(task)
            elif self._is_open(task):  # no other process has trained it meanwhile
                self._start(task, claim)
            else:
                claim.release()
        self.waiting.extendleft(reversed(held))
        if held:
            self._rescan_at = time.monotonic() + RESCAN
        self._passes = self._passes + 1 if held and not self.running else 0
        if self._passes > 1 and not self.waits and all(is_locked(task.claim) for task in held):
            self.waiting.clear()  # two looks found every task claimed elsewhere, and not only trained by one that is ending

    def _is_open(self, task: Work) -> bool:
        """Returns whether a run is to be trained, else notes how it has ended."""
        if task.is_open():
            return True
        task.ending = "failed" if task.exit_status() else "done"
        return False

    def _start(self, task: Work, claim: FileLock) -> None:
        """Starts a run, from its newest checkpoint if there is one."""
        try:
            first = newest_step(task.files.checkpoints)
            file = task.lock.with_suffix(".task")
            write_task(file, task.task())
            handle = self.launcher.start(file, task.log, task.lock)
        except OSError as error:
            claim.release()
            self._leave(task, error)
            return
        self.running.append(Attempt(task, claim, handle, first))

    def _leave(self, task: Work, error: OSError) -> None:
        """Leaves a run that cannot be started to a later process, which may be one of another machine."""
        task.ending, task.reason = "left", f"could not be started: {' '.join(str(error).split())}"
        self.say(f"{task.name} {task.reason}")

    def _end(self, attempt: Attempt, status: int) -> None:
        """Applies the rule to a run whose process ended."""
        task = attempt.task
        self.running.remove(attempt)
        task.status = status
        try:
            if status == 0 and task.has_result():
                self._note(task, "done", "")
            elif status == 0:
                self._note(task, "failed", f"ended without a result: {last_line(task.log)}")
            elif attempt.asked and (status < 0 or status in STOPPED):
                self._note(task, "stopped", "")
            elif status < 0 or status in (*STOPPED, TAKEN):
                self._go_on_later(attempt, status)
            else:
                self._note(task, "failed", f"failed with exit status {status}: {last_line(task.log)}")
        finally:
            attempt.claim.release()

    def _go_on_later(self, attempt: Attempt, status: int) -> None:
        """Puts a lost run back, unless it was lost too often."""
        task, step = attempt.task, newest_step(attempt.task.files.checkpoints)
        self._lost[task] = 0 if step > attempt.first_step else self._lost.get(task, 0) + 1
        if self._lost[task] >= MAX_LOST:
            text = f"was lost {MAX_LOST} times in a row without a new checkpoint (exit status {status})"
            self._note(task, "failed", text)
            return
        how = f"continues from step {step:,}" if step >= 0 else "starts from the beginning"
        self.say(f"{task.name} was lost (exit status {status}); it {how}")
        self.waiting.appendleft(task)

    def _note(self, task: Work, ending: Ending, reason: str) -> None:
        """Records how a run ended, and says so."""
        task.ending, task.reason = ending, reason
        self.say(f"{task.name} {reason} (log {task.log})" if reason else f"{task.name}: {ending}")
        try:
            task.ended()
        except OSError as error:
            self.say(f"{task.name} ended with exit status {task.status}, but {error}")


def claimed(task: Work) -> FileLock | None:
    """Returns the claim of a task, held by this process; None if another process claims or trains it."""
    claim = hold(task.claim)
    if claim is not None and task.is_training():
        claim.release()
        return None
    return claim
