"""Hyperparameter search with Optuna: studies in a folder, and the comparison of the winner with the default.

See :mod:`rejeu.lab.experiments.study` for the files, :mod:`rejeu.algorithms.search` for the search spaces.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rejeu import envs
from rejeu.agents import modules_of, presets
from rejeu.agents.presets import Preset
from rejeu.algorithms.search import SearchSpace
from rejeu.checkpoints.run_folder import dated
from rejeu.core.errors import MissingExtra
from rejeu.core.interrupt import Interrupt
from rejeu.lab.experiments import display, search as searches, study as studies, study_plan as plans
from rejeu.lab.experiments.process import default_workers
from rejeu.lab.experiments.search import Final, Search, Watch
from rejeu.lab.experiments.study import Study, StudyFolder, Trial
from rejeu.lab.experiments.study_plan import Measure, Pruner, StudyPlan
from rejeu.lab.reporting.report.sections import duration
from rejeu.lab.runs.config import RunConfig
from rejeu.logs.formatting import number

Echo = Callable[[str], object]


@dataclass(frozen=True)
class Result:
    """The results of a study so far; ``print`` shows a summary."""

    folder: Path
    """The study folder."""
    plan: StudyPlan
    """The settings of the study."""
    trials: tuple[Trial, ...]
    """All trials that have begun, by index."""
    best: Trial | None
    """The complete trial with the highest value; None if no trial is complete."""
    final: Final | None
    """The comparison with the default; None before it."""
    complete: bool
    """Whether all trials have ended and the winner was compared."""
    signal: int | None
    """Number of the signal that stopped the study; None if none did."""
    notes: tuple[str, ...] = ()
    """What could not be started or written."""

    @property
    def preset(self) -> Preset | None:
        """The winner as a preset."""
        path = StudyFolder(self.folder).preset
        return presets.read(path) if path.is_file() else None

    def to_dict(self) -> dict[str, Any]:
        """Returns everything as plain values."""
        compared = None if self.final is None else self.final.comparison
        return {
            "study": self.folder,
            "env_id": self.plan.default.env_id,
            "algorithm": self.plan.default.algorithm,
            "seed": self.plan.seed,
            "complete": self.complete,
            "signal": self.signal,
            "trials": [dict(vars(one)) for one in self.trials],
            "best": None if self.best is None else dict(vars(self.best)),
            "preset": StudyFolder(self.folder).preset if self.best is not None else None,
            "verdict": None if self.final is None else self.final.verdict,
            "difference": None if self.final is None else self.final.difference,
            "comparison": None if compared is None else compared.table(),
            "failed": () if self.final is None else self.final.failed,
            "notes": self.notes,
        }

    def __str__(self) -> str:
        return "\n".join(summary(self))


def tune(
    env: str,
    algorithm: str | None = None,
    *,
    trials: int = 30,
    folder: str | Path | None = None,
    workers: int | None = None,
    verbose: int = 1,
    env_kwargs: Mapping[str, Any] | None = None,
    preset: Preset | None = None,
    hyperparameters: Mapping[str, Any] | None = None,
    search: SearchSpace | None = None,
    only: tuple[str, ...] = (),
    steps: int | None = None,
    n_envs: int | None = None,
    evaluate_every: int | None = None,
    evaluate_episodes: int | None = None,
    trial_seeds: int = 1,
    final_seeds: int = 5,
    seed: int = 0,
    pruner: Pruner = "median",
    measure: Measure = "return",
    imports: Sequence[str] = (),
) -> Result:
    """Searches hyperparameters, and compares the best ones with the default on fresh seeds.

    Every training is a process of its own, so the environment is given by its id. A study in a ``folder`` that exists is
    continued: trials that were interrupted are completed, and finished ones are not repeated.

    Args:
        env: id of an environment.
        algorithm: name of the algorithm; None for that of rejeu's preset for the environment.
        trials: number of trials.
        folder: study folder; None for a new one under ``runs``.
        workers: trials at once; None for half as many as there are cores. With one the study is reproducible.
        verbose: 1 prints a line for each trial and shows the trainings, 0 nothing.
        env_kwargs: keyword arguments of the environment.
        preset: what trials start from and the winner is compared with; None for rejeu's, else the algorithm's defaults.
        hyperparameters: values that are set instead of searched.
        search: dimensions by name, which replace those of the algorithm or are added to them, such as
            ``{"learning_rate": LogUniform(1e-4, 1e-2)}``.
        only: names of the hyperparameters to search; empty for all of the search space.
        steps: environment steps of a trial; None for the preset's, else 100,000.
        n_envs: environments stepped at once.
        evaluate_every: environment steps between two evaluations; None for a tenth of ``steps``.
        evaluate_episodes: episodes of each evaluation.
        trial_seeds: seeds of each trial, which are trained at once and whose evaluations are averaged.
        final_seeds: seeds of the comparison with the default; 0 for none.
        seed: determines what is sampled and the seeds of all trainings.
        pruner: ``"median"``, ``"halving"`` (successive halving) or ``"none"``.
        measure: what is maximized: the mean ``"return"`` of the last evaluation, or its ``"success"`` rate.
        imports: modules and Python files that each training imports first, such as one that registers the algorithm.

    Ctrl-C and SIGTERM stop the trainings with a checkpoint; ``signal`` of the result is then set.

    Raises:
        ValueError: for an invalid argument, or a folder of another study.
        MissingExtra: if Optuna is not installed.
    """
    with_checks = envs.make.make_vector(env, 1, **(env_kwargs or {}))
    with_checks.close()
    plan = plans.make(
        with_checks.env_id,
        algorithm,
        env_kwargs=dict(env_kwargs or {}),
        preset=preset,
        fixed=hyperparameters,
        search=search,
        only=tuple(only),
        trials=trials,
        steps=steps,
        n_envs=n_envs,
        evaluate_every=evaluate_every,
        evaluate_episodes=evaluate_episodes,
        trial_seeds=trial_seeds,
        final_seeds=final_seeds,
        seed=seed,
        pruner=pruner,
        measure=measure,
    )
    study = open_study(plan, None if folder is None else Path(folder))
    echo: Echo = print if verbose else lambda text: None
    config = RunConfig(env=plan.default.env_id, env_kwargs=plan.env_kwargs, imports=tuple(imports))
    with Interrupt() as stop:
        result = run(study, config, workers, stop, lines(echo, study), echo, bool(verbose))
    echo(str(result))
    return result


def open_study(plan: StudyPlan, folder: Path | None) -> Study:
    """Returns the study of a folder, which is created if it is new or empty; None makes one under ``runs``.

    Raises:
        ValueError: if it is the folder of another study.
        FileExistsError: if it is something else.
    """
    return studies.open_study(StudyFolder(folder or dated("tune", plan.default.env_id, plan.default.algorithm)), plan)


def run(
    study: Study,
    config: RunConfig,
    workers: int | None,
    stop: Interrupt,
    watch: Watch,
    echo: Echo,
    progress: bool = True,
) -> Result:
    """Searches, writes the winner, compares it with the default, and writes the page about that; returns the result.

    Args:
        study: the study.
        config: the environment of all trainings and what they import, as the command line named them.
        workers: trials at once.
        stop: ends the study where it is.
        watch: called with all trials when there is news.
        echo: takes messages.
        progress: whether the trainings are shown; see :func:`rejeu.lab.experiments.display.shown`.
    """
    plan, folder = study.plan, study.folder
    at_once = workers or default_workers()
    imports = tuple(modules_of(plan.default.algorithm, config.imports))
    config = dataclasses.replace(config, imports=imports, checkpoint_minutes=plan.checkpoint_minutes)
    search = Search(study, config, at_once, stop)
    with display.shown(search.scheduler, lambda: how_far(study), progress) as show:
        search.run(watch, show)
    trials = study.trials()
    best = studies.best_of(trials)
    compared = None
    if best is not None:
        presets.write(study.preset_of(best, source(study, best)), folder.preset)
    if best is not None and not stop.requested and plan.final_seeds:
        failed: list[str] = []
        if not searches.is_default(study, study.preset_of(best, "")):
            echo(f"comparing trial {best.index} with the default: {announcement(plan, trials, at_once)}")
            failed = searches.train_final(searches.final_trainings(study, best, config), at_once, stop, echo)
        compared = None if stop.requested else searches.compared(study, best, failed)
    complete = study.is_searched() and not stop.requested and not (compared and compared.failed)
    notes = [f"trial {text}" for text in search.scheduler.left]
    if compared and compared.comparison:
        try:
            compared.comparison.save(folder.page)
            echo(f"page          {folder.page}")
        except (MissingExtra, OSError) as error:
            notes.append(f"no {folder.page.name}: {error}")
    return Result(folder.path, plan, tuple(trials), best, compared, complete, stop.signal, tuple(notes))


def how_far(study: Study) -> str:
    """Returns how many trials have ended, and which is the best so far."""
    trials = study.trials()
    text = f"{sum(one.has_ended for one in trials)} of {study.plan.trials} trials have ended"
    best = studies.best_of(trials)
    return text if best is None else f"{text}, best {study.plan.measure} {number(best.value)} (trial {best.index})"


def announcement(plan: StudyPlan, trials: Sequence[Trial] = (), workers: int = 1) -> str:
    """Returns what the final comparison trains, and about how long that takes if trials have ended.

    >>> announcement(plans.make("Pendulum-v1", steps=2000))
    '5 fresh seeds each, 10 trainings of 2,000 steps'
    """
    text = (
        f"{plan.final_seeds} fresh seeds each, {2 * plan.final_seeds} trainings of {plan.default.total_steps:,} steps"
    )
    seconds = [one.seconds for one in trials if one.state == "complete" and math.isfinite(one.seconds)]
    if not seconds:
        return text
    return f"{text}, about {duration(sum(seconds) / len(seconds) * math.ceil(2 * plan.final_seeds / workers))}"


def source(study: Study, best: Trial) -> str:
    """Returns where a winner comes from, for its preset."""
    return (
        f"rejeu tune: trial {best.index} of {study.plan.trials}, mean {study.plan.measure} {number(best.value)} of the last "
        f"evaluation on {study.plan.trial_seeds} seed{'s' * (study.plan.trial_seeds != 1)}"
    )


def lines(echo: Echo, study: Study) -> Watch:
    """Returns a function that prints a line for each trial that has ended since the last call."""
    known = {one.index for one in study.trials() if one.has_ended}

    def watch(trials: list[Trial]) -> None:
        best = studies.best_of(trials)
        for one in trials:
            if one.has_ended and one.index not in known:
                known.add(one.index)
                echo(line(one, study.plan) + "  (best)" * (one is best))

    return watch


def line(trial: Trial, plan: StudyPlan) -> str:
    """Returns a trial on one line."""
    values = settings(trial)
    if trial.state == "failed":
        return f"trial {trial.index:>3}  failed: {trial.reason}  {values}"
    at = f" at step {max(trial.evaluations, default=0):,}" if trial.state == "pruned" else ""
    return f"trial {trial.index:>3}  {trial.state}{at}  {plan.measure} {number(trial.value)}  {values}"


def settings(trial: Trial) -> str:
    """Returns the hyperparameters of a trial, on one line."""
    return " ".join(f"{name}={short(value)}" for name, value in trial.values.items())


def short(value: Any) -> str:
    """Returns the value of a hyperparameter in a few digits.

    >>> short(0.00123456789), short([64, 64])
    ('0.00123457', '[64,64]')
    """
    return f"{value:g}" if isinstance(value, float) else str(value).replace(" ", "")


def summary(result: Result) -> list[str]:
    """Returns the last lines of a study."""
    counts = {
        state: sum(one.state == state for one in result.trials)
        for state in ("complete", "pruned", "failed", "running", "waiting")
    }
    found = [f"trials        {', '.join(f'{n} {state}' for state, n in counts.items() if n) or 'none'}"]
    if result.best is None:
        found.append("best trial    none: no trial is complete")
    else:
        found.append(f"best trial    {line(result.best, result.plan)}")
        found.append(f"preset        {StudyFolder(result.folder).preset}")
    if result.final is not None:
        found.append(f"comparison    {result.final}")
        found += [f"failed        {text}" for text in result.final.failed]
    found += [f"note          {text}" for text in result.notes]
    found.append(f"study folder  {result.folder}")
    return found
