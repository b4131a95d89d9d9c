"""``rejeu tune``: searches of hyperparameters, which ``rejeu resume`` continues."""

from __future__ import annotations

from collections.abc import Iterable

from rejeu.agents import AGENTS, find_agent, find_preset
from rejeu.algorithms.search import Dimension
from rejeu.core.interrupt import NAMES, Interrupt
from rejeu.core.types import JsonObject
from rejeu.lab.cli.commands import Tune
from rejeu.lab.experiments import space, study as studies, study_plan as plans, tune as tuning
from rejeu.lab.experiments.final import announcement
from rejeu.lab.experiments.study import Study, StudyFolder
from rejeu.lab.runs import environment
from rejeu.lab.runs.arguments import Resume
from rejeu.lab.runs.config import merged
from rejeu.lab.runs.environment import Environment
from rejeu.lab.runs.output import echo
from rejeu.logs.formatting import counted, quoted

OF_THE_PLAN = (
    *("only", "measure", "seed", "trials", "steps", "trial_seeds", "final_seeds", "pruner", "backend"),
    *("evaluate_every", "evaluate_episodes", "checkpoint_minutes"),
)
"""Options that are arguments of a plan."""


def run_tune(arguments: Tune) -> tuple[int, JsonObject]:
    """Searches; the exit status is 0, 1 if a trial could not be started, 130 after Ctrl-C, 143 after SIGTERM.

    It is 2 if no trial is complete or a training of the comparison failed.
    """
    trial_env = environment.from_arguments(arguments.env, arguments)
    trial_env.vector(1, arguments.backend or "auto", arguments.seed).close()  # an error before there is a folder
    name = None if arguments.algo is None else find_agent(arguments.algo).algorithm.Config.name
    preset = find_preset(trial_env.env_id, name, arguments.preset)
    algorithm = name if preset is None else preset.algorithm
    plan = plans.make(
        trial_env.env_id,
        algorithm,
        env_argument=trial_env.run.env,
        env_kwargs=trial_env.run.env_kwargs,
        wrappers=trial_env.run.wrappers,
        preset=preset,
        fixed=merged(arguments.hyperparameters, {}),
        search=read_search(arguments.search, algorithm),
        n_envs=arguments.envs,
        **{name: getattr(arguments, name) for name in OF_THE_PLAN},
    )
    return complete(tuning.open_study(plan, arguments.out), trial_env, arguments.workers)


def resume_study(arguments: Resume) -> tuple[int, JsonObject]:
    """Continues the study of a folder; returns the exit status and the result.

    Raises:
        ValueError: for an environment that is not that of the study.
        CheckpointError: if the command line must name it again.
    """
    study = studies.open_study(StudyFolder(arguments.run))
    trial_env = environment.from_run(study.plan.run, arguments.run, arguments)
    if trial_env.env_id != study.plan.default.env_id:
        raise ValueError(f"{arguments.run} is a study of {study.plan.default.env_id}, not of {trial_env.env_id}")
    return complete(study, trial_env, arguments.workers)


def read_search(assignments: Iterable[str], algorithm: str | None) -> dict[str, Dimension]:
    """Returns the dimensions of ``--search``."""
    declared = {} if algorithm is None else getattr(AGENTS[algorithm].algorithm.Config, "search_space", {})
    return dict(space.parse(assignment, declared) for assignment in assignments)


def complete(study: Study, trial_env: Environment, workers: int | None) -> tuple[int, JsonObject]:
    """Runs a study to its end; returns the exit status and the result."""
    echo("\n".join(header(study, trial_env)))
    with Interrupt() as stop:
        result = tuning.run(study, trial_env.run, workers, stop, echo)
    echo()
    if stop.signal is not None:
        again = f"rejeu resume {quoted(study.folder.path)}{trial_env.run.again()}"
        echo(f"stopped by {NAMES[stop.signal]}; {again} continues")
    echo(str(result))
    if stop.signal is not None:
        return 128 + stop.signal, result.to_dict()
    if not study.is_searched():
        return 1, result.to_dict()
    return (0 if result.complete and result.best is not None else 2), result.to_dict()


def header(study: Study, trial_env: Environment) -> list[str]:
    """Returns the first lines of a study."""
    plan, default = study.plan, study.plan.default
    n_ended = sum(trial.state.is_finished() for trial in study.trials())
    seeds = f", {plan.trial_seeds} seeds each" if plan.trial_seeds > 1 else ""
    evaluations = f"evaluated on {counted(default.evaluate_episodes, 'episode')} every {default.evaluate_every:,} steps"
    ended = f"; {n_ended} have ended" if n_ended else ""
    return [
        f"environment   {trial_env}, {default.n_envs} at once",
        f"algorithm     {default.algorithm}, seed {plan.seed}, pruner {plan.pruner}",
        f"trials        {plan.trials} of {default.total_steps:,} steps{seeds}, {evaluations}{ended}",
        *(f"{'search' if i == 0 else '':<14}{name}: {text}" for i, (name, text) in enumerate(plan.space.items())),
        *([f"at the end    the best trial and the default: {announcement(plan)}"] if plan.final_seeds else []),
        f"study folder  {study.folder.path}",
    ]
