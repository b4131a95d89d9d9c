"""Hyperparameter search with Optuna: studies in a folder, and the comparison of the winner with the default.

See :mod:`rejeu.lab.experiments.study` for the files, :mod:`rejeu.algorithms.search` for the search spaces.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rejeu import envs
from rejeu.agents import modules_of, presets
from rejeu.agents.presets import Preset
from rejeu.algorithms.search import SearchSpace
from rejeu.checkpoints.run_folder import dated
from rejeu.core.errors import MissingExtra
from rejeu.core.interrupt import Interrupt
from rejeu.core.types import Arguments, JsonObject
from rejeu.lab.experiments import display, study as studies, study_plan as plans
from rejeu.lab.experiments.final import Final, compare_with_default
from rejeu.lab.experiments.search import Search
from rejeu.lab.experiments.study import STATES, Study, StudyFolder
from rejeu.lab.experiments.study_plan import Measure, Pruner, StudyPlan
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.runs.process import default_workers
from rejeu.logs.formatting import counted, number

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

Echo = Callable[[str], object]


@dataclass(frozen=True)
class Result:
    """The results of a study so far; ``print`` shows a summary."""

    study: Study
    """The study: its ``folder``, its ``plan``, and ``optuna_study``, that of Optuna."""
    trials: tuple[FrozenTrial, ...]
    """All trials that have begun, as Optuna has them."""
    best: FrozenTrial | None
    """The complete trial with the highest value; None if no trial is complete."""
    final: Final | None
    """The comparison with the default; None before it."""
    complete: bool
    """Whether all trials have ended and the winner was compared."""
    signal: int | None
    """Number of the signal that stopped the study; None if none did."""
    notes: tuple[str, ...] = ()
    """Trials that could not be started, and files that could not be written."""

    @property
    def folder(self) -> Path:
        """The study folder."""
        return self.study.folder.path

    @property
    def preset(self) -> Preset | None:
        """The winner as a preset."""
        return None if self.best is None else presets.read(self.study.folder.preset)

    def to_dict(self) -> JsonObject:
        """Returns everything as plain values."""
        final, default = self.final or Final("not compared"), self.study.plan.default
        return {
            **{"study": self.folder, "env_id": default.env_id, "algorithm": default.algorithm},
            **{"seed": self.study.plan.seed, "complete": self.complete, "signal": self.signal},
            "trials": [self.study.record(trial) for trial in self.trials],
            "best": None if self.best is None else self.study.record(self.best),
            "preset": None if self.best is None else self.study.folder.preset,
            **{"verdict": self.final and final.verdict, "difference": final.difference},
            "comparison": None if final.comparison is None else final.comparison.table(),
            **{"failed": final.failed, "notes": self.notes},
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
    env_kwargs: Arguments | None = None,
    preset: Preset | None = None,
    hyperparameters: Mapping[str, object] | None = None,
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
    study = open_study(plan, folder)
    echo: Echo = print if verbose else lambda text: None
    config = RunConfig(env=plan.default.env_id, env_kwargs=plan.env_kwargs, imports=tuple(imports))
    with Interrupt() as stop:
        result = run(study, config, workers, stop, echo, bool(verbose))
    echo(str(result))
    return result


def open_study(plan: StudyPlan, folder: str | Path | None) -> Study:
    """Returns the study of a folder, which is created if it is new or empty; None makes one under ``runs``.

    Raises:
        ValueError: if it is the folder of another study.
        FileExistsError: if it is something else.
    """
    path = Path(folder or dated("tune", plan.default.env_id, plan.default.algorithm))
    return studies.open_study(StudyFolder(path), plan)


def run(
    study: Study, config: RunConfig, workers: int | None, stop: Interrupt, echo: Echo, progress: bool = True
) -> Result:
    """Searches, writes the winner, compares it with the default, and writes the page about that; returns the result.

    Args:
        study: the study.
        config: the environment of all trainings and what they import, as the command line named them.
        workers: trials at once.
        stop: ends the study where it is.
        echo: takes a line for each trial that has ended, and messages.
        progress: whether the trainings are shown; see :func:`rejeu.lab.experiments.display.shown`.
    """
    plan, folder, final = study.plan, study.folder, None
    at_once = workers or default_workers()
    imports = tuple(modules_of(plan.default.algorithm, config.imports))
    config = dataclasses.replace(config, imports=imports, checkpoint_minutes=plan.checkpoint_minutes)
    search = Search(study, config, at_once, stop)
    with display.shown(search.scheduler, lambda: how_far(study), progress) as show:
        search.run(lines(echo, study), show)
    notes = [f"trial {text}" for text in search.scheduler.left]
    best = study.best()
    if best is not None:
        n_seeds = counted(plan.trial_seeds, "seed")
        value = f"mean {plan.measure} {number(study.optuna_study.best_value)} of the last evaluation on {n_seeds}"
        source = f"rejeu tune: trial {best.number} of {plan.trials}, {value}"
        presets.write(study.preset_of(best, source), folder.preset)
    if best is not None and plan.final_seeds and not stop.requested:
        final = compare_with_default(study, best, config, at_once, stop, echo)
    if final and final.comparison:
        try:
            final.comparison.save(folder.page)
            echo(f"page          {folder.page}")
        except (MissingExtra, OSError) as error:
            notes.append(f"no {folder.page.name}: {error}")
    complete = study.is_searched() and not stop.requested and not (final and final.failed)
    return Result(study, tuple(study.trials()), best, final, complete, stop.signal, tuple(notes))


def how_far(study: Study) -> str:
    """Returns how many trials have ended, and which is the best so far."""
    n_ended, best = sum(trial.state.is_finished() for trial in study.trials()), study.best()
    text = f"{n_ended} of {study.plan.trials} trials have ended"
    if best is None:
        return text
    return f"{text}, best {study.plan.measure} {number(study.optuna_study.best_value)} (trial {best.number})"


def lines(echo: Echo, study: Study) -> Callable[[], None]:
    """Returns a function that prints a line for each trial that has ended since the last call."""
    n_before = {trial.number for trial in study.trials() if trial.state.is_finished()}

    def watch() -> None:
        best = study.best()
        for trial in study.trials():
            if trial.state.is_finished() and trial.number not in n_before:
                n_before.add(trial.number)
                echo(line(study, trial) + "  (best)" * (best is not None and trial.number == best.number))

    return watch


def line(study: Study, trial: FrozenTrial) -> str:
    """Returns a trial on one line."""
    record = study.record(trial)
    values = " ".join(f"{name}={short(value)}" for name, value in record["values"].items())
    if trial.state.name == "FAIL":
        return f"trial {trial.number:>3}  failed: {record['reason']}  {values}"
    at = f" at step {trial.last_step:,}" if trial.state.name == "PRUNED" else ""
    return f"trial {trial.number:>3}  {record['state']}{at}  {study.plan.measure} {number(record['value'])}  {values}"


def short(value: object) -> str:
    """Returns the value of a hyperparameter in a few digits.

    >>> short(0.00123456789), short([64, 64])
    ('0.00123457', '[64,64]')
    """
    return f"{value:g}" if isinstance(value, float) else str(value).replace(" ", "")


def summary(result: Result) -> list[str]:
    """Returns the last lines of a study."""
    counts = Counter(STATES[trial.state.name] for trial in result.trials)
    states = ", ".join(f"{counts[state]} {state}" for state in STATES.values() if counts[state])
    words = [f"trials        {states or 'none'}"]
    if result.best is None:
        words.append("best trial    none: no trial is complete")
    else:
        words.append(f"best trial    {line(result.study, result.best)}")
        words.append(f"preset        {result.study.folder.preset}")
    if result.final is not None:
        words += [f"comparison    {result.final}", *(f"failed        {text}" for text in result.final.failed)]
    return [*words, *(f"note          {text}" for text in result.notes), f"study folder  {result.folder}"]
