"""The search: trials are begun, followed at their evaluations, pruned and ended, until the study is complete."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rejeu.experiments import scheduler as schedulers
from rejeu.experiments.process import LocalLauncher
from rejeu.experiments.scheduler import Scheduler
from rejeu.experiments.study import Outcome, State, Study
from rejeu.experiments.training import Training
from rejeu.interrupt import Interrupt
from rejeu.runs.config import RunConfig

if TYPE_CHECKING:
    import optuna

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
    state: State | None = None
    """How the trial ends once its processes have ended."""
    reason: str = ""

    def advance(self, study: Study) -> bool:
        """Reports new evaluations, and decides whether the trial is to end; returns whether there was a new one."""
        before = self.n_reported
        for training in self.trainings:
            if training.ending == "failed" and self.state is None:
                self.state, self.reason = "failed", f"seed {training.seed} {training.reason}"
        tables = [training.evaluations(study.plan.column) for training in self.trainings]
        while self.state is None and self.n_reported < min(map(len, tables)):
            step = tables[0][self.n_reported][0]
            self.value = sum(table[self.n_reported][1] for table in tables) / len(tables)
            self.n_reported += 1
            if study.report(self.trial, step, self.value):
                self.state = "pruned"
        return self.n_reported > before

    def finish(self, study: Study) -> None:
        """Writes to the study how the trial ended. Its checkpoints are deleted."""
        study.finish(self.trial, self.index, self.state or "complete", self.value, self.reason)
        for training in self.trainings:
            training.drop_checkpoints()


class Search:
    """The trials that this process trains. Mutable."""

    def __init__(self, study: Study, run: RunConfig, workers: int, stop: Interrupt) -> None:
        """Starts nothing yet; ``run`` is what all trainings have in common, and ``workers`` the number of trials at once."""
        self.study, self.run_config, self.workers, self.stop = study, run, workers, stop
        self.running: list[RunningTrial] = []
        self.scheduler = Scheduler(LocalLauncher(workers * study.plan.trial_seeds), stop)
        self._next_look = 0.0

    def run(self, watch: Watch) -> None:
        """Trains until the study is searched or a stop is requested; the next run continues interrupted trials."""
        try:
            while True:
                has_news = not self.stop.requested and self.begin()
                self.scheduler.turn()
                if self.advance() or has_news:
                    watch(self.study.outcomes())
                if not self.running and (self.stop.requested or self.study.is_searched()):
                    return
                time.sleep(schedulers.POLL)
        finally:
            self.scheduler.close()
            for one in self.running:
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
            folder = self.study.folder.trial(index)
            trainings = [
                Training(self.run_config, folder / f"seed_{seed}", seed, folder / "preset.json")
                for seed in self.study.plan.seeds(index)
            ]
            self.running.append(RunningTrial(trial, index, trainings))
            self.scheduler.waiting.extend(trainings)
            begun = True
        return begun

    def advance(self) -> bool:
        """Follows the running trials and removes those that have ended; returns whether there is news."""
        has_news = False
        for one in list(self.running):
            has_ended = all(training.ending for training in one.trainings)  # before the evaluations are read
            was_stopped = self.stop.requested and any(training.ending == "stopped" for training in one.trainings)
            has_news |= one.advance(self.study)
            if one.state is not None:
                self.scheduler.ask_to_stop(*one.trainings)
            if not has_ended:
                continue
            self.running.remove(one)
            has_news = True
            if was_stopped and one.state is None:
                self.study.release(one.index)
            else:
                one.finish(self.study)
                self._next_look = 0.0
        return has_news
