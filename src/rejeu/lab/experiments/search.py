"""The trainings of a study: trials are begun, followed at their evaluations, pruned and ended, and the winner is compared.

Each training is one process of ``rejeu train``, with a run folder of its own. In the final comparison, the winner and the
default are trained on fresh seeds that the study did not use.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from rejeu.agents import AGENTS, presets
from rejeu.agents.presets import Preset
from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core import validation
from rejeu.core.interrupt import Interrupt
from rejeu.lab.experiments.process import LocalLauncher
from rejeu.lab.experiments.scheduler import Scheduler
from rejeu.lab.experiments.study import State, Study, StudyFolder, Trial
from rejeu.lab.experiments.study_plan import MIN_FINAL_SEEDS, Measure
from rejeu.lab.experiments.work import Job, Work
from rejeu.lab.reporting.comparison import Comparison, compare
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.runs.read import RunSummary, read_run
from rejeu.logs import statistics
from rejeu.logs.tables import read_table

if TYPE_CHECKING:
    import optuna

IDLE = 5.0
"""Seconds between two looks at trials that other processes run."""
DEFAULT = "default"
SAMPLES = 10_000
"""Bootstrap samples of the difference."""

Watch = Callable[["list[Trial]"], object]
"""Called with all trials when one has begun, was evaluated, or has ended."""
Verdict = Literal["better", "worse", "no difference found", "the default itself", "not compared"]


def work_of(run: RunConfig, folder: Path, seed: int) -> Work:
    """Returns the training of a preset in a folder, on a seed, where ``run`` is what all trainings of the study share."""
    of_preset = dataclasses.replace(run, preset=str(StudyFolder(folder).preset), seed=seed, imports=())
    job = Job(name=f"seed_{seed}", run=of_preset, no_report=True, no_video=True)
    name = f"{folder.name}, {job.label}"
    return Work(folder, job, run.imports, is_retried=True, name=name, keeps_checkpoints=False)


def evaluations(work: Work, column: str) -> list[tuple[int, float]]:
    """Returns step and value of each evaluation so far."""
    try:
        table = read_table(work.files.evaluations)
    except OSError:
        return []
    return list(zip(table.column("step").astype(int).tolist(), table.column(column).tolist(), strict=True))


@dataclass(eq=False)
class RunningTrial:
    """A trial that this process trains, on one or several seeds. Mutable."""

    trial: optuna.Trial
    index: int
    trainings: list[Work]
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
                self.state, self.reason = "failed", f"{training.job.label} {training.reason}"
        tables = [evaluations(training, study.plan.column) for training in self.trainings]
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
        self.watch: Watch = lambda trials: None
        self._next_look = 0.0

    def run(self, watch: Watch, show: Callable[[], object] = lambda: None) -> None:
        """Trains until the study is searched, a stop is requested or a training cannot be started.

        The next run continues the trials that were interrupted or not started. ``show`` is called several times a second.
        """
        self.watch = watch
        try:
            self.scheduler.run(show, self.turn)
        finally:
            for one in self.running:
                self.study.release(one.index)

    def turn(self) -> bool:
        """Follows the running trials and begins others; returns whether any trial runs or is left. The policy of a study."""
        has_news = self.advance()
        is_over = self.stop.requested or bool(self.scheduler.left)
        if (not is_over and self.begin()) or has_news:
            self.watch(self.study.trials())
        return bool(self.running) or not (is_over or self.study.is_searched())

    def begin(self) -> bool:
        """Begins trials while there are free workers and trials left; returns whether any was begun."""
        begun = False
        while len(self.running) < self.workers and time.monotonic() >= self._next_look:
            taken = self.study.take()
            if taken is None:
                self._next_look = time.monotonic() + IDLE
                break
            trial, index = taken
            folder = self.study.folder.trial(index)
            trainings = [work_of(self.run_config, folder, seed) for seed in self.study.plan.seeds(index)]
            self.running.append(RunningTrial(trial, index, trainings))
            self.scheduler.add(trainings)
            begun = True
        return begun

    def advance(self) -> bool:
        """Follows the running trials and removes those that have ended; returns whether there is news."""
        has_news = False
        for one in list(self.running):
            has_ended = all(training.ending for training in one.trainings)  # before the evaluations are read
            has_news |= one.advance(self.study)
            if one.state is not None:
                self.scheduler.ask_to_stop(*one.trainings)
            if not has_ended:
                continue
            self.running.remove(one)
            has_news = True
            if one.state is None and any(training.ending in ("stopped", "left") for training in one.trainings):
                self.study.release(one.index)
            else:
                one.finish(self.study)
                self._next_look = 0.0
        return has_news


@dataclass(frozen=True)
class Final:
    """The result of the comparison."""

    verdict: Verdict
    difference: tuple[float, float, float] | None
    """Interquartile mean of the winner's last evaluations minus that of the default's, and its 95 % interval."""
    comparison: Comparison | None
    failed: tuple[str, ...]
    """Trainings that failed, with the reason."""
    measure: Measure = "return"

    def __str__(self) -> str:
        if self.verdict == "not compared":
            return "the winner was not compared with the default" + (f": {self.failed[0]}" if self.failed else "")
        if self.verdict == "the default itself":
            return "the best trial has the hyperparameters of the default; there is nothing to compare"
        assert self.difference is not None
        value, low, high = self.difference
        text = f"by {value:,.4g} in IQM {self.measure} (95 % interval {low:,.4g} to {high:,.4g})"
        if self.verdict == "no difference found":
            return f"on fresh seeds the winner is not shown to be better than the default: they differ {text}"
        return f"on fresh seeds the winner is {self.verdict} than the default {text}"


def winner_name(best: Trial) -> str:
    """Returns the name of the winner's folder and group."""
    return f"trial_{best.index:04d}"


def is_default(study: Study, winner: Preset) -> bool:
    """Returns whether a preset has the hyperparameters of the default."""
    config = AGENTS[study.plan.default.algorithm].algorithm.Config
    own = (validation.build(config, values) for values in (winner.hyperparameters, study.plan.default.hyperparameters))
    return next(own) == next(own)


def final_trainings(study: Study, best: Trial, run: RunConfig) -> list[Work]:
    """Returns all trainings of the comparison, in pairs; their presets are written."""
    named = {
        winner_name(best): study.preset_of(best, f"trial {best.index}"),
        DEFAULT: study.plan.preset(study.plan.default.hyperparameters, "the default"),
    }
    for name, preset in named.items():
        presets.write(preset, StudyFolder(study.folder.final / name).preset)
    folders = [study.folder.final / name for name in named]
    return [work_of(run, folder, seed) for seed in study.plan.fresh_seeds() for folder in folders]


def train_final(tasks: Sequence[Work], workers: int, stop: Interrupt, echo: Callable[[str], object]) -> list[str]:
    """Trains winner and default on the fresh seeds, as many as ``workers`` at once; returns the failures.

    Trainings that other processes hold are waited for; finished ones are not repeated.
    """

    def say(text: str) -> None:
        n = sum(task.ending not in (None, "stopped") for task in tasks)
        echo(f"final comparison: {n} of {len(tasks)} trainings have ended; {text}")

    scheduler = Scheduler(LocalLauncher(workers), stop, say, waits=True)
    scheduler.add(tasks)
    scheduler.run()
    return [f"{task.name}: {task.reason}" for task in tasks if task.ending in ("failed", "left")]


def compared(study: Study, best: Trial, failed: list[str]) -> Final:
    """Returns the comparison of the trainings that are there."""
    if is_default(study, study.preset_of(best, "")):
        return Final("the default itself", None, None, ())
    runs = {name: finished(study.folder.final / name) for name in (winner_name(best), DEFAULT)}
    labels = {winner_name(best): f"winner (trial {best.index})", DEFAULT: DEFAULT}
    if min(map(len, runs.values())) < MIN_FINAL_SEEDS:
        return Final("not compared", None, None, tuple(failed))
    labeled = [named(run, labels[name]) for name, found in runs.items() for run in found]
    comparison = compare(labeled, "algorithm", score="evaluation", seed=study.plan.seed)
    winner, default = ([last_values(found, study.plan.column)] for found in runs.values())
    value, low, high = difference(winner, default, study.plan.seed)
    verdict: Verdict = "better" if low > 0 else "worse" if high < 0 else "no difference found"
    return Final(verdict, (value, low, high), comparison, tuple(failed), study.plan.measure)


def named(run: RunSummary, label: str) -> RunSummary:
    """Returns a run whose algorithm has another name, which makes its group."""
    return dataclasses.replace(run, config=dataclasses.replace(run.config, algorithm=label))


def finished(folder: Path) -> list[RunSummary]:
    """Returns the finished runs in a folder."""
    found = [read_run(path) for path in sorted(folder.glob("seed_*")) if RunFolder(path).config.is_file()]
    return [run for run in found if run.state == "finished"]


def last_values(runs: Sequence[RunSummary], column: str) -> np.ndarray:
    """Returns a column of the last evaluation of each run, ``float64 (n_runs,)``."""
    return np.array([run.evaluations.column(column)[-1] for run in runs])


def difference(one: statistics.Scores, other: statistics.Scores, seed: int) -> tuple[float, float, float]:
    """Returns the difference of the interquartile means of two groups, and its 95 % bootstrap interval.

    >>> difference([np.array([2.0, 2.0])], [np.array([1.0, 1.0])], 0)
    (1.0, 1.0, 1.0)
    """
    rng = np.random.default_rng(seed)
    values = []
    for scores in (one, other):
        samples = statistics.resampled(scores, statistics.draw(scores, SAMPLES, rng))
        values.append((statistics.iqm(scores), statistics.iqm(samples)))
    low, high = statistics.interval(values[0][1] - values[1][1])
    return float(values[0][0] - values[1][0]), float(low), float(high)
