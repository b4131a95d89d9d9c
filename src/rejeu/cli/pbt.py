"""``rejeu pbt``: population-based training in a folder, and its continuation by ``rejeu resume``."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Any

from rejeu.cli import environment, jsonout
from rejeu.cli.commands import Pbt, Resume
from rejeu.cli.environment import Environment
from rejeu.cli.output import echo
from rejeu.cli.tune import common, shared
from rejeu.experiments import population as populations
from rejeu.experiments.population import Members
from rejeu.experiments.process import default_workers
from rejeu.interrupt import NAMES, Interrupt
from rejeu.runs.folder import check_free
from rejeu.runs.values import quoted

FILE = "population.json"
"""File that makes a folder one of a population."""


def run(arguments: Pbt) -> int:
    """Trains and returns the exit status: 0, 130 after Ctrl-C, 143 after SIGTERM."""
    return jsonout.run(pbt, arguments)


def pbt(arguments: Pbt) -> tuple[int, dict[str, Any]]:
    """Trains; returns the exit status and the result."""
    check_free(arguments.out)
    made = environment.from_arguments(arguments.env, arguments)
    made.vector(1, arguments.backend or "auto", arguments.seed).close()
    population = populations.make(
        arguments.rounds, arguments.round_steps, arguments.members, env_id=made.env_id, **shared(arguments, made)
    )
    name = re.sub(r"[^\w.-]+", "-", f"pbt-{made.env_id}-{population.plan.algorithm}-{time.strftime('%Y%m%d-%H%M%S')}")
    members = populations.create(arguments.out or Path("runs") / name, population)
    return train(members, made, arguments.workers)


def resume(arguments: Resume) -> tuple[int, dict[str, Any]]:
    """Continues the population of a folder; returns the exit status and the result.

    Raises:
        ValueError: for options of a run, or an environment that is not that of the population.
    """
    if arguments.steps is not None or arguments.minutes is not None or arguments.hyperparameters:
        raise ValueError(f"{arguments.run} is a population of rejeu pbt; leave out --steps, --minutes and --set")
    members = populations.read(arguments.run)
    plan = members.population.plan
    made = environment.from_run(plan.env_id, plan.env_argument, plan.env_kwargs, plan.wrappers, members.path, arguments)
    if made.env_id != plan.env_id:
        raise ValueError(f"{arguments.run} is a population of {plan.env_id}, not of {made.env_id}")
    return train(members, made, arguments.workers)


def train(members: Members, made: Environment, workers: int | None) -> tuple[int, dict[str, Any]]:
    """Trains a population to its end; returns the exit status and the result."""
    population, plan = members.population, members.population.plan
    at_once = min(workers or default_workers(), population.members)
    echo(f"environment   {made}, {plan.n_envs} at once")
    echo(f"algorithm     {plan.algorithm}, seed {plan.seed}")
    echo(f"population    {population.members} members, {population.rounds} rounds of {plan.evaluate_every:,} steps")
    for i, (name, dimension) in enumerate(plan.search_space.items()):
        echo(f"{'changing' if i == 0 else '':<14}{name}: {dimension}")
    echo(f"folder        {members.path}")
    with members.lock(), Interrupt() as stop:
        complete = populations.train(members, common(made, plan.algorithm), at_once, stop, echo)
    result = as_dict(members, complete, stop.signal)
    if stop.signal is not None:
        echo(f"stopped by {NAMES[stop.signal]}; rejeu resume {quoted(members.path)}{made.options()} continues")
        return 128 + stop.signal, result
    echo(f"\nbest member   {result['best']['member']}: {plan.measure} {result['best']['score']:,.4g}")
    echo(f"model         {members.path / 'best.safetensors'}")
    echo(f"history       {members.path / 'history.csv'}")
    return 0, result


def as_dict(members: Members, complete: bool, signal: int | None) -> dict[str, Any]:
    """Returns the result for ``--json``."""
    plan, history = members.population.plan, members.history()
    best = None
    if complete:
        member = members.best()
        best = next(row for row in reversed(history) if row["member"] == member)
    return {
        "population": members.path,
        "env_id": plan.env_id,
        "algorithm": plan.algorithm,
        "seed": plan.seed,
        "complete": complete,
        "signal": signal,
        "best": best,
        "history": history,
    }
