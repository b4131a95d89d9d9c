"""``rejeu tune``: a search of hyperparameters in a study folder, and its continuation by ``rejeu resume``."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from typing import Any

from rejeu import presets, tuning
from rejeu.agents import AGENTS, agent_of_file, find_agent
from rejeu.algorithms.search import Dimension
from rejeu.cli import environment, jsonout, settings
from rejeu.cli.commands import Pbt, Resume, Tune
from rejeu.cli.environment import Environment
from rejeu.cli.output import echo
from rejeu.interrupt import NAMES, Interrupt
from rejeu.presets import Preset
from rejeu.reporting.text import counted
from rejeu.tuning import plan as plans, space, study as studies
from rejeu.tuning.plan import Plan
from rejeu.tuning.study import Study, StudyFolder
from rejeu.tuning.training import env_options


def run(arguments: Tune) -> int:
    """Searches and returns the exit status: 0, 2 if no trial is complete or a training of the comparison failed, 130, 143."""
    return jsonout.run(tune, arguments)


def tune(arguments: Tune) -> tuple[int, dict[str, Any]]:
    """Searches; returns the exit status and the result."""
    made = environment.from_arguments(arguments.env, arguments)
    made.vector(1, arguments.backend or "auto", arguments.seed).close()
    study = tuning.open_study(make_plan(arguments, made), arguments.out)
    return complete(study, made, arguments.imports, arguments.workers)


def resume(arguments: Resume) -> tuple[int, dict[str, Any]]:
    """Continues the study of a folder; returns the exit status and the result.

    Raises:
        ValueError: for ``--steps`` or ``--minutes``, or an environment that is not that of the study.
    """
    if arguments.steps is not None or arguments.minutes is not None:
        raise ValueError(
            f"{arguments.run} is a study of rejeu tune, whose trials have a length; leave out --steps and --minutes"
        )
    study = studies.join(StudyFolder(arguments.run))
    plan = study.plan
    made = environment.from_run(
        plan.env_id, plan.env_argument, plan.env_kwargs, plan.wrappers, study.folder.path, arguments
    )
    if made.env_id != plan.env_id:
        raise ValueError(f"{arguments.run} is a study of {plan.env_id}, not of {made.env_id}")
    return complete(study, made, arguments.imports, arguments.workers)


def make_plan(arguments: Tune, made: Environment) -> Plan:
    """Returns the plan of the study that the command line asks for."""
    preset = None if arguments.preset is None else presets.read(arguments.preset)
    return plans.make(
        made.env_id,
        arguments.algo,
        env_argument=made.typed,
        env_kwargs=made.kwargs,
        wrappers=made.wrapper_names,
        preset=preset,
        fixed=settings.apply(chain.from_iterable(arguments.assignments), {}),
        search=read_search(chain.from_iterable(arguments.search), algorithm_of(arguments, made, preset)),
        only=tuple(chain.from_iterable(arguments.only)),
        trials=arguments.trials,
        steps=arguments.steps,
        n_envs=arguments.envs,
        backend=arguments.backend,
        evaluate_every=arguments.evaluate_every,
        evaluate_episodes=arguments.evaluate_episodes,
        trial_seeds=arguments.trial_seeds,
        final_seeds=arguments.final_seeds,
        seed=arguments.seed,
        pruner=arguments.pruner,
        measure=arguments.measure,
        checkpoint_minutes=arguments.checkpoint_minutes,
    )


def algorithm_of(arguments: Tune | Pbt, made: Environment, preset: Preset | None) -> str | None:
    """Returns the name of the algorithm to tune, None if it is not known."""
    if arguments.algo is not None:
        return find_agent(arguments.algo).algorithm.Config.name
    found = preset or presets.find(made.env_id)
    if found is None:
        return None
    agent_of_file(found.algorithm, arguments.preset or "the preset")
    return found.algorithm


def read_search(assignments: Iterable[str], algorithm: str | None) -> dict[str, Dimension]:
    """Returns the dimensions of ``--search``."""
    declared = {} if algorithm is None else getattr(AGENTS[algorithm].algorithm.Config, "search_space", {})
    return dict(space.parse(one, declared) for one in assignments)


def complete(
    study: Study, made: Environment, imports: tuple[str, ...], workers: int | None
) -> tuple[int, dict[str, Any]]:
    """Runs a study to its end; returns the exit status and the result."""
    echo("\n".join(header(study, made)))
    options = env_options(made.kwargs, made.wrapper_names, imports)
    with Interrupt() as stop:
        result = tuning.run(study, made.typed, options, workers, stop, tuning.lines(echo, study), echo)
    echo()
    if stop.signal is not None:
        again = "".join(f" --import {name}" for name in imports)
        echo(f"stopped by {NAMES[stop.signal]}; rejeu resume {study.folder.path}{made.options()}{again} continues")
    echo(str(result))
    if stop.signal is not None:
        return 128 + stop.signal, result.to_dict()
    return (0 if result.complete and result.best is not None else 2), result.to_dict()


def header(study: Study, made: Environment) -> list[str]:
    """Returns the first lines of a study."""
    plan = study.plan
    done = sum(one.state not in ("waiting", "running") for one in study.outcomes())
    seeds = f", {plan.trial_seeds} seeds each" if plan.trial_seeds > 1 else ""
    return [
        f"environment   {made}, {plan.n_envs} at once",
        f"algorithm     {plan.algorithm}, seed {plan.seed}, pruner {plan.pruner}",
        f"trials        {plan.trials} of {plan.steps:,} steps{seeds}, evaluated on "
        f"{counted(plan.evaluate_episodes, 'episode')} every {plan.evaluate_every:,} steps"
        + f"; {done} have ended"
        * bool(done),
        *(f"{'search' if i == 0 else '':<14}{name}: {one}" for i, (name, one) in enumerate(plan.search_space.items())),
        f"study folder  {study.folder.path}",
    ]
