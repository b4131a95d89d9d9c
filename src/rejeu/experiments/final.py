"""The winner against the default: both are trained on fresh seeds that the study did not use, and compared."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from rejeu import presets, validation
from rejeu.agents import AGENTS
from rejeu.experiments.process import LocalLauncher
from rejeu.experiments.scheduler import Scheduler
from rejeu.experiments.study import Outcome, Study
from rejeu.experiments.study_plan import MIN_FINAL_SEEDS, Measure
from rejeu.experiments.training import Training
from rejeu.interrupt import Interrupt
from rejeu.presets import Preset
from rejeu.reporting import statistics
from rejeu.reporting.comparison import Comparison, compare
from rejeu.reporting.runs import Run, read_run
from rejeu.runs.config import RunConfig

DEFAULT = "default"
SAMPLES = 10_000
"""Bootstrap samples of the difference."""

Verdict = Literal["better", "worse", "no difference found", "the default itself", "not compared"]


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


def winner_name(best: Outcome) -> str:
    """Returns the name of the winner's folder and group."""
    return f"trial_{best.index:04d}"


def is_default(study: Study, winner: Preset) -> bool:
    """Returns whether a preset has the hyperparameters of the default."""
    config = AGENTS[study.plan.algorithm].algorithm.Config
    own = (validation.build(config, values) for values in (winner.hyperparameters, study.plan.default))
    return next(own) == next(own)


def trainings(study: Study, best: Outcome, run: RunConfig) -> list[Training]:
    """Returns all trainings of the comparison, in pairs; their presets are written."""
    named = {
        winner_name(best): study.preset_of(best, f"trial {best.index}"),
        DEFAULT: study.plan.preset(study.plan.default, "the default"),
    }
    for name, preset in named.items():
        presets.write(preset, study.folder.final / name / "preset.json")
    return [
        Training(run, folder / f"seed_{seed}", seed, folder / "preset.json", folder / f"seed_{seed}.claim")
        for seed in study.plan.fresh_seeds()
        for folder in (study.folder.final / name for name in named)
    ]


def train(tasks: Sequence[Training], workers: int, stop: Interrupt, echo: Callable[[str], object]) -> list[str]:
    """Trains winner and default on the fresh seeds, as many as ``workers`` at once; returns the failures.

    Trainings that other processes hold are waited for; finished ones are not repeated.
    """

    def say(text: str) -> None:
        n = sum(task.ending is not None for task in tasks)
        echo(f"final comparison: {n} of {len(tasks)} trainings have ended; {text}")

    scheduler = Scheduler(LocalLauncher(workers), stop, say, waits=True)
    scheduler.waiting.extend(tasks)
    scheduler.run()
    return [f"{task.name}: {task.reason}" for task in tasks if task.ending == "failed"]


def result(study: Study, best: Outcome, failed: list[str]) -> Final:
    """Returns the comparison of the trainings that are there."""
    if is_default(study, study.preset_of(best, "")):
        return Final("the default itself", None, None, ())
    runs = {name: finished(study.folder.final / name) for name in (winner_name(best), DEFAULT)}
    labels = {winner_name(best): f"winner (trial {best.index})", DEFAULT: DEFAULT}
    if min(map(len, runs.values())) < MIN_FINAL_SEEDS:
        return Final("not compared", None, None, tuple(failed))
    labeled = [dataclasses.replace(run, algorithm=labels[name]) for name, found in runs.items() for run in found]
    comparison = compare(labeled, "algorithm", score="evaluation", seed=study.plan.seed)
    winner, default = ([last_values(found, study.plan.column)] for found in runs.values())
    value, low, high = difference(winner, default, study.plan.seed)
    verdict: Verdict = "better" if low > 0 else "worse" if high < 0 else "no difference found"
    return Final(verdict, (value, low, high), comparison, tuple(failed), study.plan.measure)


def finished(folder: Path) -> list[Run]:
    """Returns the finished runs in a folder."""
    found = [read_run(path) for path in sorted(folder.glob("seed_*")) if (path / "config.json").is_file()]
    return [run for run in found if run.state == "finished"]


def last_values(runs: Sequence[Run], column: str) -> np.ndarray:
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
