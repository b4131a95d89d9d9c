"""The trainings of a study: trials are begun, followed at their evaluations, pruned and ended.

Each training is one process of ``rejeu train``, with a run folder of its own.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from rejeu.core.interrupt import Interrupt
from rejeu.lab.experiments.scheduler import Scheduler
from rejeu.lab.experiments.study import RunningTrial, Study
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.runs.process import LocalLauncher

IDLE = 5.0
"""Seconds between two looks at trials that other processes train."""


class Search:
    """The trials that this process trains. Mutable."""

    def __init__(self, study: Study, run: RunConfig, workers: int, stop: Interrupt) -> None:
        """Starts nothing yet; ``run`` is common to all trainings, and ``workers`` the number of trials at once."""
        self.study, self.run_config, self.workers, self.stop = study, run, workers, stop
        self.running: list[RunningTrial] = []
        self.scheduler = Scheduler(LocalLauncher(workers * study.plan.trial_seeds), stop)
        self.next_look = 0.0

    def run(self, watch: Callable[[], object], show: Callable[[], object] = lambda: None) -> None:
        """Trains until the study is searched, a stop is requested or a training cannot be started.

        The next run continues the trials that were interrupted. ``watch`` is called when a trial has begun, was evaluated or
        has ended, ``show`` several times a second.
        """
        try:
            self.scheduler.run(show, lambda: self.turn(watch))
        finally:
            for trial in self.running:
                trial.lock.release()

    def turn(self, watch: Callable[[], object]) -> bool:
        """Follows the running trials and begins others; returns whether any trial runs or is left. The policy of a study."""
        n_news = sum([self.follow(trial) for trial in [*self.running]])
        is_over = self.stop.requested or bool(self.scheduler.left)
        while not is_over and len(self.running) < self.workers and time.monotonic() >= self.next_look:
            n_news += self.begin()
        if n_news:
            watch()
        return bool(self.running) or not (is_over or self.study.is_searched())

    def begin(self) -> bool:
        """Begins or continues a trial; returns whether there was one."""
        trial = self.study.take(self.run_config)
        if trial is None:
            self.next_look = time.monotonic() + IDLE
            return False
        self.running.append(trial)
        self.scheduler.add(trial.trainings)
        return True

    def follow(self, trial: RunningTrial) -> bool:
        """Follows a running trial to its end; returns whether there is news of it."""
        are_over = all(training.ending for training in trial.trainings)  # before the evaluations are read
        has_news = trial.advance(self.study.plan)
        if trial.has_ended:
            self.scheduler.ask_to_stop(*trial.trainings)
        if are_over:
            self.running.remove(trial)
            self.next_look = 0.0
            if not trial.has_ended and any(training.ending in ("stopped", "left") for training in trial.trainings):
                trial.lock.release()
            else:
                trial.finish(self.study.plan)
        return has_news or are_over
