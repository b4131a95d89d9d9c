"""The search: trials are begun, followed at their evaluations, pruned and ended, until the study is complete."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rejeu.interrupt import Interrupt
from rejeu.tuning.study import Outcome, State, Study
from rejeu.tuning.training import Command, Training

if TYPE_CHECKING:
    import optuna

POLL = 0.2
"""Seconds between two looks at the processes."""
IDLE = 5.0
"""Seconds between two looks at trials that other processes run."""

Watch = Callable[["list[Outcome]"], object]
"""Called with all trials when one has begun, was evaluated, or has ended."""


@dataclass(eq=False)
class RunningTrial:
    """A trial that this process trains, on one or several seeds. Mutable."""

    trial: optuna.Trial
    index: int
    trainings: list[Training]
    n_reported: int = 0
    """Evaluations that Optuna knows."""
    value: float = math.nan
    """Mean over the seeds of the last of them."""
    ending: State | None = None
    """How the trial ends once its processes have ended."""
    reason: str = ""

    def advance(self, study: Study) -> bool:
        """Reports new evaluations, and asks the processes to stop if the trial is to end; returns whether one was new."""
        before = self.n_reported
        for training in self.trainings:
            if training.has_ended() and training.status != 0 and self.ending is None:
                self.end("failed", f"seed {training.seed}, exit status {training.status}: {training.last_line()}")
        tables = [training.evaluations(study.plan.column) for training in self.trainings]
        while self.ending is None and self.n_reported < min(map(len, tables)):
            step = tables[0][self.n_reported][0]
            self.value = sum(table[self.n_reported][1] for table in tables) / len(tables)
            self.n_reported += 1
            if study.report(self.trial, step, self.value):
                self.end("pruned", "")
        return self.n_reported > before

    def end(self, state: State, reason: str) -> None:
        """Asks the processes to stop; the trial ends in this state when they have."""
        self.ending, self.reason = state, reason
        self.stop()

    def stop(self) -> None:
        """Asks the processes to stop, with a checkpoint."""
        for training in self.trainings:
            training.stop()

    def has_ended(self) -> bool:
        """Returns whether all processes have ended."""
        ended = [training.has_ended() for training in self.trainings]
        return all(ended)

    def finish(self, study: Study) -> None:
        """Writes to the study how the trial ended. Its checkpoints are deleted."""
        study.finish(self.trial, self.index, self.ending or "complete", self.value, self.reason)
        for training in self.trainings:
            training.drop_checkpoints()


@dataclass(eq=False)
class Search:
    """The trials that this process trains. Mutable."""

    study: Study
    command: Command
    workers: int
    """Trials at once."""
    running: list[RunningTrial] = field(default_factory=list)
    _next_look: float = 0.0

    def run(self, stop: Interrupt, watch: Watch) -> None:
        """Trains until the study is searched or ``stop`` is requested; interrupted trials are continued by the next run."""
        was_stopped = False
        try:
            while True:
                has_news = False if stop.requested else self.begin()
                if stop.requested and not was_stopped:
                    was_stopped = True
                    for one in self.running:
                        one.stop()
                has_news |= self.advance(stop)
                if has_news:
                    watch(self.study.outcomes())
                if not self.running and (stop.requested or self.study.is_searched()):
                    return
                time.sleep(POLL)
        finally:
            for one in self.running:
                for training in one.trainings:
                    training.kill()
                self.study.release(one.index)

    def begin(self) -> bool:
        """Begins trials while there are free workers and trials left; returns whether any was begun."""
        begun = False
        while len(self.running) < self.workers and time.monotonic() >= self._next_look:
            taken = self.study.take()
            if taken is None:
                self._next_look = time.monotonic() + IDLE
                break
            trial, index, _ = taken
            folder, plan = self.study.folder.trial(index), self.study.plan
            trainings = [Training(folder / f"seed_{seed}", seed, folder / "preset.json") for seed in plan.seeds(index)]
            self.running.append(RunningTrial(trial, index, trainings))
            for training in trainings:
                training.start(self.command, plan.checkpoint_minutes)
            begun = True
        return begun

    def advance(self, stop: Interrupt) -> bool:
        """Follows the running trials and removes those that have ended; returns whether there is news."""
        has_news = False
        for one in list(self.running):
            has_ended = one.has_ended()  # before the evaluations are read, so that none is missed
            was_stopped = stop.requested and any(training.status != 0 for training in one.trainings)
            if not was_stopped:
                has_news |= one.advance(self.study)
            if not has_ended:
                continue
            self.running.remove(one)
            has_news = True
            if was_stopped and one.ending is None:
                self.study.release(one.index)
            else:
                one.finish(self.study)
                self._next_look = 0.0
        return has_news
