"""A study in a folder: the trials in Optuna's journal, shared by processes and machines through locks on files.

::

    study.json              the plan
    journal.log             Optuna's journal: what was tried, and how it went
    trials/0007/            preset.json, and a run folder for each seed
    final/                  the winner and the default on fresh seeds, a run folder for each seed
    preset.json             the winner
    compare.html            the comparison of the winner with the default

Every trial has an index from 0. A trial whose process died is entered again with the same index and parameters, so that the
study continues as it would have without the interruption.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from filelock import FileLock

from rejeu.agents import presets
from rejeu.agents.presets import Preset
from rejeu.checkpoints.model_files import WRONG
from rejeu.checkpoints.run_folder import File
from rejeu.core import atomic
from rejeu.core.errors import CheckpointError, requires
from rejeu.core.records import json_text
from rejeu.lab.experiments import space as spaces, study_plan as plans
from rejeu.lab.experiments.folder import begin
from rejeu.lab.experiments.process import hold
from rejeu.lab.experiments.study_plan import StudyPlan
from rejeu.lab.experiments.work import HIDDEN
from rejeu.lab.runs.read import is_locked

if TYPE_CHECKING:
    import optuna

NAME = "rejeu"
"""Name of the study in its journal."""
INDEX, REPEATS, REASON = "index", "repeats", "reason"
"""User attributes of trials: the index, the number of the interrupted trial that is repeated, why a trial failed."""
STARTUP_TRIALS = 5
"""Trials before the first one is pruned."""
LOCK = "trial.lock"
"""File that the process locks which runs a trial."""

State = Literal["waiting", "running", "complete", "pruned", "failed"]


@dataclass(frozen=True)
class Trial:
    """What is known of one trial."""

    index: int
    state: State
    value: float
    """Of the last evaluation; NaN if there is none."""
    values: Mapping[str, Any]
    """The hyperparameters that were sampled."""
    evaluations: Mapping[int, float]
    """The value at each evaluation, by environment step."""
    seconds: float
    """Wall time; NaN if unknown."""
    reason: str
    """Why it failed."""

    @property
    def has_ended(self) -> bool:
        """Whether it is neither waiting nor running."""
        return self.state in ("complete", "pruned", "failed")


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

    def trial(self, index: int) -> Path:
        """Returns the folder of a trial."""
        return self.path / "trials" / f"{index:04d}"

    def lock(self) -> FileLock:
        """Returns the lock that is held while trials are entered."""
        return atomic.lock(self.path / HIDDEN / "lock")


@dataclass(eq=False)
class Study:
    """An open study. Mutable."""

    folder: StudyFolder
    plan: StudyPlan
    optuna_study: optuna.Study
    held: dict[int, FileLock] = field(default_factory=dict)
    """Locks of the trials that this process trains, by index."""

    def take(self) -> tuple[optuna.Trial, int] | None:
        """Returns the next trial with its index, locks it, and writes its preset; None if no trial is left to begin.

        Trials whose process has died come first. The sampler, TPE, expects nothing of trials that still run.
        """
        from optuna.samplers import TPESampler

        with self.folder.lock(), readable(self.folder.journal):
            self.enter_interrupted()
            index = self.next_index()
            if index is None:
                return None
            space = self.plan.search_space
            self.optuna_study.sampler = TPESampler(seed=self.plan.sampler_seed(index), constant_liar=True)
            trial = self.optuna_study.ask(spaces.distributions(space))
            trial.set_user_attr(INDEX, index)
            lock = hold(self.folder.trial(index) / LOCK)
            assert lock is not None, "trials are entered under the lock of the study"
            self.held[index] = lock
        values = spaces.decoded(space, trial.params)
        source = f"rejeu tune, trial {index} of a study with seed {self.plan.seed}"
        preset = self.plan.preset(spaces.applied(self.plan.fixed, values), source)
        presets.write(preset, StudyFolder(self.folder.trial(index)).preset)
        return trial, index

    def next_index(self) -> int | None:
        """Returns the index of the next trial: of one that waits, else a new one; None if all have begun."""
        trials = self.optuna_study.get_trials(deepcopy=False)
        waiting = [one.user_attrs[INDEX] for one in trials if one.state.name == "WAITING"]
        if waiting:
            return int(waiting[0])
        index = len({one.user_attrs[INDEX] for one in trials if INDEX in one.user_attrs})
        return index if index < self.plan.trials else None

    def enter_interrupted(self) -> None:
        """Enters running trials that no process holds again, with the same index and parameters."""
        from optuna.trial import TrialState

        trials = self.optuna_study.get_trials(deepcopy=False)
        repeated = {one.user_attrs.get(REPEATS) for one in trials}
        names = spaces.distributions(self.plan.search_space).keys()
        for one in trials:
            index = one.user_attrs.get(INDEX)
            if one.state.name != "RUNNING" or (index is not None and is_locked(self.folder.trial(index) / LOCK)):
                continue
            if index is not None and one.number not in repeated:
                params = dict(one.params) if one.params.keys() >= names else {}
                self.optuna_study.enqueue_trial(params, user_attrs={INDEX: index, REPEATS: one.number})
            self.optuna_study.tell(one.number, state=TrialState.FAIL)

    def report(self, trial: optuna.Trial, step: int, value: float) -> bool:
        """Adds an evaluation to a trial; returns whether the trial is to be pruned."""
        with readable(self.folder.journal):
            trial.report(value, step)
            return step < self.plan.default.total_steps and trial.should_prune()

    def finish(self, trial: optuna.Trial, index: int, state: State, value: float = math.nan, reason: str = "") -> None:
        """Ends a trial and releases its lock. A trial without a finite value has failed."""
        from optuna.trial import TrialState

        if state == "complete" and not math.isfinite(value):
            state, reason = "failed", f"its last evaluation has the {self.plan.measure} {value}"
        with readable(self.folder.journal):
            if reason:
                trial.set_user_attr(REASON, reason[:500])
            name = {"complete": "COMPLETE", "pruned": "PRUNED", "failed": "FAIL"}[state]
            self.optuna_study.tell(trial, value if state == "complete" else None, TrialState[name])
        self.release(index)

    def release(self, index: int) -> None:
        """Releases the lock of a trial."""
        if index in self.held:
            self.held.pop(index).release()

    def trials(self) -> list[Trial]:
        """Returns all trials by index, each once."""
        with readable(self.folder.journal):
            trials = self.optuna_study.get_trials(deepcopy=False)
            found = {one.user_attrs[INDEX]: self.trial_of(one) for one in trials if INDEX in one.user_attrs}
        return [found[index] for index in sorted(found)]

    def trial_of(self, trial: optuna.trial.FrozenTrial) -> Trial:
        """Returns what is known of a trial of Optuna."""
        states: dict[str, State] = {"FAIL": "failed", "COMPLETE": "complete", "PRUNED": "pruned", "RUNNING": "running"}
        last = trial.intermediate_values.get(trial.last_step) if trial.last_step is not None else None
        value = trial.value if trial.value is not None else last
        return Trial(
            index=int(trial.user_attrs[INDEX]),
            state=states.get(trial.state.name, "waiting"),
            value=math.nan if value is None else float(value),
            values=spaces.decoded(self.plan.search_space, trial.params),
            evaluations=dict(sorted(trial.intermediate_values.items())),
            seconds=trial.duration.total_seconds() if trial.duration is not None else math.nan,
            reason=str(trial.user_attrs.get(REASON, "")),
        )

    def is_searched(self) -> bool:
        """Returns whether all trials have ended."""
        return sum(one.has_ended for one in self.trials()) >= self.plan.trials

    def preset_of(self, trial: Trial, source: str) -> Preset:
        """Returns a trial as a preset."""
        return self.plan.preset(spaces.applied(self.plan.fixed, trial.values), source)


def best_of(trials: list[Trial]) -> Trial | None:
    """Returns the complete trial with the highest value, of equals the first; None without one."""
    return max((one for one in trials if one.state == "complete"), key=lambda one: one.value, default=None)


def open_study(folder: StudyFolder, plan: StudyPlan | None = None) -> Study:
    """Opens the study of a folder; with ``plan`` it is created if there is none.

    The plan of one that exists must be the same, except for the number of trials and of final seeds. The first trial has the
    values of the default, as far as they lie in the search space.

    Raises:
        FileExistsError: if the folder holds something else.
        FileNotFoundError: if there is no study, without ``plan``.
        ValueError: if the plan differs.
        CheckpointError: if a file is damaged.
    """
    require()
    there = (
        plans.read(folder.plan) if plan is None else begin(folder.path, plans.FILE, plan, plans.read, plans.difference)
    )
    plan = plan or there
    with folder.lock():
        if there != plan:
            atomic.write(folder.plan, json_text(plan))
        study = connect(folder, plan)
        if not study.get_trials(deepcopy=False):
            values = plans.default_values(plan)
            study.enqueue_trial(spaces.encoded(plan.search_space, values), user_attrs={INDEX: 0})
    return Study(folder, plan, study)


def connect(folder: StudyFolder, plan: StudyPlan) -> optuna.Study:
    """Returns Optuna's study of a folder, which is created if it does not exist.

    Raises:
        CheckpointError: if the journal is damaged.
    """
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    lock: Any = atomic.lock(f"{folder.journal}.held")  # released with the process, as those of Optuna are not
    complete_last_line(folder.journal, lock)
    with readable(folder.journal):
        return optuna.create_study(
            storage=JournalStorage(JournalFileBackend(str(folder.journal), lock)),
            study_name=NAME,
            direction="maximize",
            load_if_exists=True,
            pruner=make_pruner(plan),
        )


def complete_last_line(journal: Path, lock: Any) -> None:
    """Cuts the part of a line at the end of a journal that a killed process left behind; Optuna cannot read on after it.

    Raises:
        CheckpointError: if it is a symbolic link.
    """
    if journal.is_symlink():
        raise CheckpointError(f"{journal} is a link and no file; it is from another program")
    if not journal.is_file():
        return
    with lock:
        content = journal.read_bytes()
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
    except (*WRONG, AssertionError, OptunaError) as error:
        raise CheckpointError(
            f"{journal} is damaged: {type(error).__name__}: {' '.join(str(error).split())[:200]}; restore it from a copy, or "
            "begin a study in another folder"
        ) from error


def require() -> None:
    """Raises :class:`MissingExtra` if Optuna is not installed."""
    with requires("rejeu tune", "optuna", "tune"):
        import optuna  # noqa: F401 - only whether it is there


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
