"""A study in a folder, which Optuna stores, samples and prunes, and the trials of it that this process trains.

::

    study.json              the plan
    journal.log             Optuna's journal: what was tried, and how it went
    trials/0007/            preset.json, and a run folder for each seed
    final/                  the winner and the default on fresh seeds, a run folder for each seed
    preset.json             the winner
    compare.html            the comparison of the winner with the default

A trial is entered into the journal with all of its hyperparameters at once, and the process that trains it holds a lock. A
running trial whose lock is free has lost its process: the next process continues it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rejeu.agents import presets
from rejeu.agents.presets import Preset
from rejeu.checkpoints.model_files import WRONG
from rejeu.checkpoints.run_folder import File
from rejeu.core import atomic
from rejeu.core.errors import CheckpointError, requires
from rejeu.core.records import brief, json_text, read_bytes
from rejeu.core.types import JsonObject
from rejeu.lab.experiments import space as spaces, study_plan as plans
from rejeu.lab.experiments.folder import MAX_BYTES, begin
from rejeu.lab.experiments.study_plan import StudyPlan
from rejeu.lab.experiments.work import HIDDEN, Job, Work
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.runs.process import hold
from rejeu.logs.tables import read_table

if TYPE_CHECKING:
    import optuna
    from filelock import FileLock
    from optuna.trial import FrozenTrial

NAME = "rejeu"
"""Name of the study in its journal."""
REASON = "reason"
"""User attribute of trials: why a trial failed."""
STATES = {"COMPLETE": "complete", "PRUNED": "pruned", "FAIL": "failed", "RUNNING": "running"}
"""States of trials by Optuna's names."""
STARTUP_TRIALS = 5
"""Trials before the first one is pruned."""


@dataclass(frozen=True)
class StudyFolder:
    """The files of a study."""

    path: Path

    plan = File(plans.FILE)
    """The settings of the study."""
    journal = File("journal.log")
    """Optuna's journal."""
    preset = File("preset.json")
    """The winner; in the folder of a trial, what is trained."""
    page = File("compare.html")
    """The page that compares the winner with the default."""
    final = File("final")
    """Folder of the final comparison."""
    lock = File("trial.lock")
    """In the folder of a trial: locked by the process that trains it."""

    def trial(self, index: int) -> StudyFolder:
        """Returns the folder of a trial."""
        return StudyFolder(self.path / "trials" / f"{index:04d}")

    def trainings(self, run: RunConfig, seeds: list[int]) -> list[Work]:
        """Returns the trainings of the preset in this folder on some seeds; ``run`` is common to all of the study."""
        run = dataclasses.replace(run, preset=str(self.preset))
        jobs = [
            Job(name=f"seed_{seed}", run=dataclasses.replace(run, seed=seed, imports=()), no_report=True, no_video=True)
            for seed in seeds
        ]
        names = [f"{self.path.name}, {job.label}" for job in jobs]
        pairs = zip(jobs, names, strict=True)
        return [Work(self.path, job, run.imports, True, name, keeps_checkpoints=False) for job, name in pairs]


@dataclass(eq=False)
class RunningTrial:
    """A trial that this process trains, on one or several seeds. Mutable."""

    trial: optuna.Trial
    lock: FileLock
    trainings: list[Work]
    evaluations: dict[int, float]
    """The evaluations that Optuna has: the mean over the seeds, by environment step."""
    has_ended: bool = False
    """Whether its end is in the journal; its processes may still have to stop."""

    def advance(self, plan: StudyPlan) -> bool:
        """Reports new evaluations and ends the trial early if it is to be; returns whether there was a new one."""
        n_before = len(self.evaluations)
        for training in self.trainings:
            if training.ending == "failed" and not self.has_ended:
                self.end("FAIL", f"{training.job.label} {training.reason}")
        tables = [evaluations(training, plan.column) for training in self.trainings]
        for rows in zip(*tables, strict=False):  # one training may be ahead of another
            step = rows[0][0]
            if not self.has_ended and step not in self.evaluations:
                self.evaluations[step] = sum(value for _, value in rows) / len(rows)
                self.trial.report(self.evaluations[step], step)
                if step < plan.default.total_steps and self.trial.should_prune():
                    self.end("PRUNED")
        return len(self.evaluations) > n_before

    def end(self, state: str, reason: str = "", value: float | None = None) -> None:
        """Writes to the journal how the trial ended: one of Optuna's states, why it failed, and its value."""
        from optuna.trial import TrialState

        if reason:
            self.trial.set_user_attr(REASON, reason[:500])
        self.trial.study.tell(self.trial, value, TrialState[state])
        self.has_ended = True

    def finish(self, plan: StudyPlan) -> None:
        """Deletes the checkpoints of a trial whose processes have ended. Without a finite last evaluation it has failed."""
        value = self.evaluations[max(self.evaluations)] if self.evaluations else math.nan
        if not self.has_ended and math.isfinite(value):
            self.end("COMPLETE", value=value)
        elif not self.has_ended:
            self.end("FAIL", f"its last evaluation has the {plan.measure} {value}")
        for training in self.trainings:
            training.drop_checkpoints()
        self.lock.release()


def evaluations(training: Work, column: str) -> list[tuple[int, float]]:
    """Returns step and value of each evaluation so far."""
    table = read_table(training.files.evaluations)
    return list(zip(table.column("step").astype(int).tolist(), table.column(column).tolist(), strict=True))


@dataclass(eq=False)
class Study:
    """An open study. Mutable."""

    folder: StudyFolder
    plan: StudyPlan
    lock: FileLock
    """Held while the journal is written, and while a trial is entered or continued."""
    optuna_study: optuna.Study
    storage: optuna.storages.BaseStorage

    def take(self, run: RunConfig) -> RunningTrial | None:
        """Returns a trial to train, with its preset written: one that lost its process, else a new one; None without one."""
        with self.lock, readable(self.folder.journal):
            for trial in self.trials():
                if trial.state.name == "RUNNING" and (lock := hold(self.folder.trial(trial.number).lock)) is not None:
                    return self.running(trial, lock, run)
            if len(self.trials()) >= self.plan.trials:
                return None
            self.optuna_study.add_trial(self.sampled())
            trial = self.trials()[-1]
            new = hold(self.folder.trial(trial.number).lock)
            assert new is not None, "trials are entered under the lock of the study"
            return self.running(trial, new, run)

    def sampled(self) -> FrozenTrial:
        """Returns a new trial. The first one has the values of the default, as far as they lie in the search space.

        A copy of the study is asked for it, because Optuna would write its parameters to the journal one after the other.
        """
        from optuna import create_study
        from optuna.samplers import TPESampler
        from optuna.trial import TrialState, create_trial

        space, trials = self.plan.search_space, self.trials()
        study = create_study(sampler=TPESampler(seed=self.plan.sampler_seed(len(trials))), direction="maximize")
        study.add_trials(trials)
        if not trials:
            study.enqueue_trial(spaces.parameters(space, self.plan.configuration))
        trial = study.ask()
        spaces.suggested(trial, space)
        return create_trial(state=TrialState.RUNNING, params=trial.params, distributions=trial.distributions)

    def running(self, trial: FrozenTrial, lock: FileLock, run: RunConfig) -> RunningTrial:
        """Returns a trial of the journal as one that this process trains."""
        from optuna import Trial

        folder, study_id = self.folder.trial(trial.number), self.storage.get_study_id_from_name(NAME)
        source = f"rejeu tune, trial {trial.number} of a study with seed {self.plan.seed}"
        presets.write(self.preset_of(trial, source), folder.preset)
        trial_id = self.storage.get_trial_id_from_study_id_trial_number(study_id, trial.number)
        trainings = folder.trainings(run, self.plan.seeds(trial.number))
        return RunningTrial(Trial(self.optuna_study, trial_id), lock, trainings, {**trial.intermediate_values})

    def trials(self) -> list[FrozenTrial]:
        """Returns all trials, except for those that another program enqueued."""
        with readable(self.folder.journal):
            return [trial for trial in self.optuna_study.get_trials(deepcopy=False) if trial.state.name != "WAITING"]

    def best(self) -> FrozenTrial | None:
        """Returns the complete trial with the highest value, of equals the first; None without one."""
        return self.optuna_study.best_trial if any(trial.state.name == "COMPLETE" for trial in self.trials()) else None

    def is_searched(self) -> bool:
        """Returns whether all trials have ended."""
        trials = self.trials()
        return len(trials) >= self.plan.trials and all(trial.state.is_finished() for trial in trials)

    def record(self, trial: FrozenTrial) -> JsonObject:
        """Returns a trial as plain values, those of a file that may be damaged."""
        with readable(self.folder.journal):
            evaluations = {step: float(value) for step, value in sorted(trial.intermediate_values.items())}
            last = evaluations.get(max(evaluations, default=0), math.nan)
            value = last if trial.value is None else float(trial.value)
            return {
                "index": trial.number,
                "state": STATES[trial.state.name],
                "value": value,
                "values": spaces.suggested(trial, self.plan.search_space),
                "evaluations": evaluations,
                "seconds": math.nan if trial.duration is None else trial.duration.total_seconds(),
                "reason": str(trial.user_attrs.get(REASON, "")),
            }

    def preset_of(self, trial: FrozenTrial, source: str) -> Preset:
        """Returns a trial as a preset."""
        return self.plan.preset(spaces.applied(self.plan.fixed, self.record(trial)["values"]), source)


def open_study(folder: StudyFolder, plan: StudyPlan | None = None) -> Study:
    """Opens the study of a folder, whose trials are checked; with ``plan`` it is created if there is none.

    The plan of one that exists must be the same, except for the number of trials and of final seeds.

    Raises:
        FileExistsError: if the folder holds something else.
        FileNotFoundError: if there is no study, without ``plan``.
        ValueError: if the plan differs.
        CheckpointError: if a file is damaged.
        MissingExtra: if Optuna is not installed.
    """
    with requires("rejeu tune", "optuna", "tune"):
        import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    there = (
        plans.read(folder.plan) if plan is None else begin(folder.path, plans.FILE, plan, plans.read, plans.difference)
    )
    plan = plan or there
    if there != plan:
        atomic.write(folder.plan, json_text(plan))
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    atomic.make_folder(folder.path / HIDDEN)
    lock: FileLock = atomic.lock(folder.path / HIDDEN / "lock")  # unlike Optuna's, it ends with its process
    with lock, readable(folder.journal):
        cut_last_line(folder.journal)
        storage = JournalStorage(JournalFileBackend(str(folder.journal), lock))
        study = optuna.create_study(
            storage=storage, study_name=NAME, direction="maximize", load_if_exists=True, pruner=make_pruner(plan)
        )
        if [direction.name for direction in study.directions] != ["MAXIMIZE"]:
            raise ValueError("it does not maximize one value")
    opened = Study(folder, plan, lock, study, storage)
    for trial in opened.trials():
        opened.record(trial)
    return opened


def cut_last_line(journal: Path) -> None:
    """Cuts the part of a line at the end of a journal that a killed process left behind; Optuna cannot read on after it.

    Raises:
        CheckpointError: if it is a symbolic link.
        Malformed: if it has more than ``MAX_BYTES`` bytes, of which Optuna would make far more.
    """
    if journal.is_symlink():
        raise CheckpointError(f"{journal} is a link and no file; it is from another program")
    content = read_bytes(journal, MAX_BYTES) if journal.is_file() else b""
    if content and not content.endswith(b"\n"):
        with atomic.open_file(journal, "r+b") as file:
            file.truncate(content.rfind(b"\n") + 1)


@contextmanager
def readable(journal: Path) -> Iterator[None]:
    """Context in which errors of reading a journal become a :class:`CheckpointError` of one line."""
    from optuna.exceptions import OptunaError

    try:
        yield
    except CheckpointError:
        raise
    except (*WRONG, AssertionError, RuntimeError, OptunaError) as error:
        raise CheckpointError(
            f"{journal} is damaged: {type(error).__name__}: {brief(error)}; restore it from a copy, or begin another study"
        ) from error


def make_pruner(plan: StudyPlan) -> optuna.pruners.BasePruner:
    """Returns the pruner of a plan.

    ``median`` prunes a trial below the median of the earlier trials at the same step, after a third of its steps;
    ``halving`` lets a quarter of the trials pass after 1, 4, 16 ... evaluations.
    """
    from optuna import pruners

    if plan.pruner == "median":
        return pruners.MedianPruner(n_startup_trials=STARTUP_TRIALS, n_warmup_steps=plan.default.total_steps // 3)
    if plan.pruner == "halving":
        return pruners.SuccessiveHalvingPruner(min_resource=plan.default.evaluate_every)
    return pruners.NopPruner()
