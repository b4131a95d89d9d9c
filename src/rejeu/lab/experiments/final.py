"""The end of a study: the winner and the default are trained on fresh seeds that no trial had, and compared."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from rejeu.agents import AGENTS, presets
from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core import validation
from rejeu.core.interrupt import Interrupt
from rejeu.lab.experiments.scheduler import Scheduler
from rejeu.lab.experiments.study import Study, StudyFolder
from rejeu.lab.experiments.study_plan import MIN_FINAL_SEEDS, Measure, StudyPlan
from rejeu.lab.reporting.comparison import Comparison, compare
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.runs.process import LocalLauncher
from rejeu.lab.runs.read import RunSummary, read_run
from rejeu.logs import statistics

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

SAMPLES = 10_000
"""Bootstrap samples of the difference."""

Verdict = Literal["better", "worse", "no difference found", "the default itself", "not compared"]


@dataclass(frozen=True)
class Final:
    """The result of the comparison."""

    verdict: Verdict
    difference: tuple[float, float, float] | None = None
    """Interquartile mean of the winner's last evaluations minus that of the default's, and its 95 % interval."""
    comparison: Comparison | None = None
    failed: tuple[str, ...] = ()
    """Trainings that failed, with the reason."""
    measure: Measure = "return"

    def __str__(self) -> str:
        if self.verdict == "the default itself":
            return "the best trial has the hyperparameters of the default; there is nothing to compare"
        if self.difference is None:
            return ": ".join(["the winner was not compared with the default", *self.failed[:1]])
        value, low, high = self.difference
        text = f"by {value:,.4g} in IQM {self.measure} (95 % interval {low:,.4g} to {high:,.4g})"
        if self.verdict == "no difference found":
            return f"on fresh seeds the winner is not shown to be better than the default: they differ {text}"
        return f"on fresh seeds the winner is {self.verdict} than the default {text}"


def is_default(study: Study, winner: FrozenTrial) -> bool:
    """Returns whether a trial has the hyperparameters of the default."""
    config = AGENTS[study.plan.default.algorithm].algorithm.Config
    values = study.preset_of(winner, "").hyperparameters
    return validation.build(config, values) == validation.build(config, study.plan.default.hyperparameters)


def final_folders(study: Study, winner: FrozenTrial) -> dict[str, StudyFolder]:
    """Returns the folders of the comparison by the labels of their groups."""
    names = {f"winner (trial {winner.number})": f"trial_{winner.number:04d}", "default": "default"}
    return {label: StudyFolder(study.folder.final / name) for label, name in names.items()}


def compare_with_default(
    study: Study, winner: FrozenTrial, run: RunConfig, workers: int, stop: Interrupt, echo: Callable[[str], object]
) -> Final | None:
    """Trains winner and default on the fresh seeds, as many as ``workers`` at once, and compares them; None if stopped.

    Trainings that other processes hold are waited for; finished ones are not repeated.
    """
    if is_default(study, winner):
        return Final("the default itself")
    echo(f"comparing trial {winner.number} with the default: {announcement(study.plan)}")
    folders, default = final_folders(study, winner), dataclasses.replace(study.plan.default, source="the default")
    for folder, preset in zip(
        folders.values(), (study.preset_of(winner, f"trial {winner.number}"), default), strict=True
    ):
        presets.write(preset, folder.preset)
    pairs = zip(*(folder.trainings(run, study.plan.fresh_seeds()) for folder in folders.values()), strict=True)
    trainings = [training for pair in pairs for training in pair]

    def say(text: str) -> None:
        n_ended = sum(training.ending not in (None, "stopped") for training in trainings)
        echo(f"final comparison: {n_ended} of {len(trainings)} trainings have ended; {text}")

    scheduler = Scheduler(LocalLauncher(workers), stop, say, waits=True)
    scheduler.add(trainings)
    scheduler.run()
    failed = tuple(f"{work.name}: {work.reason}" for work in trainings if work.ending in ("failed", "left"))
    return None if stop.requested else compared(study, winner, failed)


def announcement(plan: StudyPlan) -> str:
    """Returns the trainings of the final comparison.

    >>> from rejeu.lab.experiments import study_plan as plans
    >>> announcement(plans.make("Pendulum-v1", steps=2000))
    '5 fresh seeds each, 10 trainings of 2,000 steps'
    """
    n_seeds, steps = plan.final_seeds, plan.default.total_steps
    return f"{n_seeds} fresh seeds each, {2 * n_seeds} trainings of {steps:,} steps"


def compared(study: Study, winner: FrozenTrial, failed: tuple[str, ...] = ()) -> Final:
    """Returns the comparison of the trainings that are there."""
    plan = study.plan
    groups = [finished(folder, label) for label, folder in final_folders(study, winner).items()]
    if min(map(len, groups)) < MIN_FINAL_SEEDS:
        return Final("not compared", failed=failed)
    comparison = compare([run for group in groups for run in group], "algorithm", score="evaluation", seed=plan.seed)
    value, low, high = difference([last_values(group, plan.column) for group in groups], plan.seed)
    verdict: Verdict = "better" if low > 0 else "worse" if high < 0 else "no difference found"
    return Final(verdict, (value, low, high), comparison, failed, plan.measure)


def finished(folder: StudyFolder, label: str) -> list[RunSummary]:
    """Returns the finished runs in a folder, whose algorithm gets the label, which makes their group."""
    paths = (path for path in sorted(folder.path.glob("seed_*")) if RunFolder(path).config.is_file())
    runs = [run for run in map(read_run, paths) if run.state == "finished"]
    return [dataclasses.replace(run, config=dataclasses.replace(run.config, algorithm=label)) for run in runs]


def last_values(runs: Sequence[RunSummary], column: str) -> np.ndarray:
    """Returns a column of the last evaluation of each run, ``float64 (n_runs,)``."""
    return np.array([run.evaluations.column(column)[-1] for run in runs])


def difference(groups: Sequence[np.ndarray], seed: int) -> tuple[float, float, float]:
    """Returns how much greater the interquartile mean of the first of two groups is, and the 95 % bootstrap interval.

    >>> difference([np.array([2.0, 2.0]), np.array([1.0, 1.0])], 0)
    (1.0, 1.0, 1.0)
    """
    rng, values = np.random.default_rng(seed), []
    for scores in groups:
        samples = statistics.resampled([scores], statistics.draw([scores], SAMPLES, rng))
        values.append((statistics.iqm([scores]), statistics.iqm(samples)))
    (winner, winner_samples), (default, default_samples) = values
    low, high = statistics.interval(winner_samples - default_samples)
    return float(winner - default), float(low), float(high)
