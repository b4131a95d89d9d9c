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
from rejeu.core.records import brief
from rejeu.lab.experiments.work import Ending, Work
from rejeu.lab.runs.config import write_task
from rejeu.lab.runs.process import hold, last_line
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
    """Starts runs, as processes of this machine or as tasks on a cluster."""

    @property
    def capacity(self) -> int:
        """Runs at once; may change."""

    def start(self, task: Path, log: Path) -> Handle:
        """Starts a run with the command line ``rejeu --task FILE``."""

    def close(self) -> None:
        """Ends what it started."""


@dataclass(eq=False)
class Attempt:
    """A run with its process. Mutable."""

    work: Work
    claim: FileLock
    handle: Handle
    first_step: int
    """Step of the checkpoint that it began from, -1 for none."""
    asked: bool = False
    """Whether it was asked to stop."""


class Scheduler:
    """Works through runs until none is left that this process may take. Mutable."""

    def __init__(self, launcher: Launcher, stop: Interrupt, say: Say = lambda text: None, waits: bool = False) -> None:
        """Starts nothing yet.

        Args:
            launcher: what starts runs.
            stop: a requested stop ends all runs, with checkpoints.
            say: called with a line for each event.
            waits: whether to wait for runs that other processes have claimed, rather than to leave them to these.
        """
        self.launcher, self.stop, self.say, self.waits = launcher, stop, say, waits
        self.works: list[Work] = []
        """All that were added."""
        self.waiting: deque[Work] = deque()
        """Runs that this process may still take."""
        self.running: list[Attempt] = []
        self._lost: dict[Work, int] = {}
        """How often in a row a run was lost without a new checkpoint."""
        self._rescan_at = 0.0
        self._passes = 0
        """How often in a row every waiting run was held by another process."""

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
            while True:
                may_add = policy()  # asked in every turn
                if not self.turn() and not may_add:
                    break
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
            self.ask_to_stop(*self.waiting, *(attempt.work for attempt in self.running))
        if self.waiting and len(self.running) < self.launcher.capacity and time.monotonic() >= self._rescan_at:
            self._start_some()
        return bool(self.running or self.waiting)

    def ask_to_stop(self, *works: Work) -> None:
        """Asks runs to stop with a checkpoint, and forgets those that wait."""
        for work in works:
            if work in self.waiting:
                self.waiting.remove(work)
                work.ending = "stopped"
        for attempt in self.running:
            if attempt.work in works and not attempt.asked:
                attempt.asked = True
                attempt.handle.stop()

    def _start_some(self) -> None:
        """Starts runs until there is no capacity left, or none that nobody else holds."""
        held: list[Work] = []
        while self.waiting and len(self.running) < self.launcher.capacity:
            work = self.waiting.popleft()
            try:
                claim = claimed(work)
            except OSError as error:
                self._leave(work, error)
                continue
            if claim is None:
                held.append(work)
            elif self._is_open(work):  # no other process has trained it meanwhile
                self._start(work, claim)
            else:
                claim.release()
        self.waiting.extendleft(reversed(held))
        if held:
            self._rescan_at = time.monotonic() + RESCAN
        self._passes = self._passes + 1 if held and not self.running else 0
        if self._passes > 1 and not self.waits and all(is_locked(work.claim) for work in held):
            self.waiting.clear()  # two looks found every run claimed elsewhere, and not only trained by one that is ending

    def _is_open(self, work: Work) -> bool:
        """Returns whether a run is to be trained, else notes how it has ended."""
        if work.is_open():
            return True
        work.ending = "failed" if work.exit_status() else "done"
        return False

    def _start(self, work: Work, claim: FileLock) -> None:
        """Starts a run, from its newest checkpoint if there is one."""
        try:
            first = newest_step(work.files.checkpoints)
            file = work.claim.with_suffix(".task")
            write_task(file, work.task())
            handle = self.launcher.start(file, work.log)
        except OSError as error:
            claim.release()
            self._leave(work, error)
            return
        self.running.append(Attempt(work, claim, handle, first))

    def _leave(self, work: Work, error: OSError) -> None:
        """Leaves a run that cannot be started to a later process, which may be one of another machine."""
        work.ending, work.reason = "left", f"could not be started: {brief(error)}"
        self.say(f"{work.name} {work.reason}")

    def _end(self, attempt: Attempt, status: int) -> None:
        """Applies the rule to a run whose process ended."""
        work = attempt.work
        self.running.remove(attempt)
        work.status = status
        try:
            if status == 0 and work.has_result():
                self._note(work, "done", "")
            elif status == 0:
                self._note(work, "failed", f"ended without a result: {last_line(work.log)}")
            elif attempt.asked and (status < 0 or status in STOPPED):
                self._note(work, "stopped", "")
            elif status < 0 or status in (*STOPPED, TAKEN):
                self._go_on_later(attempt, status)
            else:
                self._note(work, "failed", f"failed with exit status {status}: {last_line(work.log)}")
        finally:
            attempt.claim.release()

    def _go_on_later(self, attempt: Attempt, status: int) -> None:
        """Puts a lost run back, unless it was lost too often."""
        work, step = attempt.work, newest_step(attempt.work.files.checkpoints)
        self._lost[work] = 0 if step > attempt.first_step else self._lost.get(work, 0) + 1
        if self._lost[work] >= MAX_LOST:
            text = f"was lost {MAX_LOST} times in a row without a new checkpoint (exit status {status})"
            self._note(work, "failed", text)
            return
        how = f"continues from step {step:,}" if step >= 0 else "starts from the beginning"
        self.say(f"{work.name} was lost (exit status {status}); it {how}")
        self.waiting.appendleft(work)

    def _note(self, work: Work, ending: Ending, reason: str) -> None:
        """Records how a run ended, and says so."""
        work.ending, work.reason = ending, reason
        self.say(f"{work.name} {reason} (log {work.log})" if reason else f"{work.name}: {ending}")
        try:
            work.ended()
        except OSError as error:
            self.say(f"{work.name} ended with exit status {work.status}, but {error}")


def claimed(work: Work) -> FileLock | None:
    """Returns the claim of a run, held by this process; None if another process claims or trains it."""
    claim = hold(work.claim)
    if claim is not None and work.is_training():
        claim.release()
        return None
    return claim
