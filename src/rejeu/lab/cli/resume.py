"""``rejeu resume`` and ``rejeu branch``: a run goes on from a checkpoint.

A run is continued exactly where it was stopped, a complete one is trained further, or a new run begins from the state of
another.
"""

from __future__ import annotations

import dataclasses
import secrets
import shutil
import warnings
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from rejeu.agents import Agent, agent_of_file
from rejeu.algorithms import config as configs
from rejeu.checkpoints.run_folder import RunFolder, check_free, checkpoint_files, create, step_of
from rejeu.core import atomic, devices
from rejeu.core.errors import RunInUseError
from rejeu.core.interrupt import Interrupt
from rejeu.envs.make import WorkerOptions
from rejeu.lab.cli import environment as environments, sweep, tune
from rejeu.lab.cli.commands import Branch, Continued, Resume
from rejeu.lab.cli.output import Stopwatch, echo
from rejeu.lab.cli.session import Session, TrainingLimits, has_reached_goal, make_evaluation_env
from rejeu.lab.experiments.folder import is_sweep
from rejeu.lab.experiments.study import StudyFolder
from rejeu.lab.reporting.runs import is_file, is_locked
from rejeu.lab.runs import config as configs_of_runs
from rejeu.lab.runs.config import DecidedRun, Origin, merged, read_folder
from rejeu.lab.runs.requests import drop
from rejeu.logs.logging import require
from rejeu.logs.tables import read_table


def run_resume(arguments: Resume) -> tuple[int, dict[str, Any]]:
    """Trains, as ``rejeu train``, ``rejeu sweep`` or ``rejeu tune`` does.

    Raises:
        ValueError: for options of a sweep with the folder of a run, or of a run with that of a sweep or a study.
        RunInUseError: if another process trains there.
        OSError: if there is a symbolic link in the folder.
    """
    atomic.check_no_links(arguments.run)
    holds_sweep = is_sweep(arguments.run)
    if holds_sweep or StudyFolder(arguments.run).plan.is_file():
        if arguments.steps is not None or arguments.minutes is not None:
            raise ValueError(f"{arguments.run} holds runs that have a length; leave out --steps and --minutes")
        return sweep.resume(arguments) if holds_sweep else tune.resume_study(arguments)
    if arguments.workers is not None:
        raise ValueError(f"{arguments.run} is a single run; --workers is for the folder of a sweep or a study")
    folder = RunFolder(arguments.run)
    if is_locked(folder.lock):  # before the tables are opened, which the other process writes
        raise RunInUseError(f"another process is training in {folder.path}; wait for it, or stop it")
    drop(folder.stop)  # a later one is for this process
    return resume(arguments, folder.checkpoints, lambda agent, config: (folder, config), arguments.finish)


def run_branch(arguments: Branch) -> tuple[int, dict[str, Any]]:
    """Trains, as ``rejeu resume`` does, in a folder of its own, which is there once the checkpoint is read."""
    check_free(arguments.out)
    parent = RunFolder(arguments.run)
    read_folder(parent)  # it has no checkpoint to name if it is no run folder
    checkpoint = nearest(parent.checkpoints, arguments.at)

    def begin(agent: Agent, config: DecidedRun) -> tuple[RunFolder, DecidedRun]:
        folder = create(arguments.out, config.env, config.algorithm, config.seed)
        for table in (parent.metrics, parent.metrics.with_suffix(".json"), parent.evaluations):
            if is_file(table):
                shutil.copyfile(table, folder.path / table.name)  # the session leaves out later rows
        agent.run_id = secrets.token_hex(8)
        write_best(agent, folder.best)
        step = step_of(checkpoint)
        nearest_to = (
            "" if arguments.at in (None, step) else f", whose checkpoint nearest before step {arguments.at:,} is used"
        )
        echo(f"branch of     {parent.path}{nearest_to}")
        origin = Origin(run=str(parent.path), step=step, changes=arguments.hyperparameters)
        return folder, dataclasses.replace(config, origin=origin)

    return resume(arguments, checkpoint, begin)


def write_best(agent: Agent, path: Path) -> None:
    """Writes the model that evaluated best so far, if there is one; the file of the other run may be of a later step."""
    run, best = agent.run, agent.best
    if best is None or best.by != "evaluation":
        return
    now = run.state, run.step
    run.state, run.step = best.state, best.step
    try:
        agent.save(path)
    finally:
        run.state, run.step = now


def nearest(checkpoints: Path, step: int | None) -> Path:
    """Returns the newest checkpoint up to a step; None for the newest of all.

    Raises:
        FileNotFoundError: if there is none.
    """
    every = checkpoint_files(checkpoints)
    found = next((path for path in every if step is None or step_of(path) <= step), None)
    if found is None:
        steps = ", ".join(f"{step_of(path):,}" for path in reversed(every))
        has = f"there are those of steps {steps}" if every else f"there is no checkpoint in {checkpoints}"
        raise FileNotFoundError(f"--at {step}: no checkpoint is of this step or before it; {has}")
    return found


def resume(
    arguments: Continued,
    checkpoint: Path,
    begin: Callable[[Agent, DecidedRun], tuple[RunFolder, DecidedRun]],
    finish: bool = False,
) -> tuple[int, dict[str, Any]]:
    """Trains; returns the exit status and the result.

    Args:
        arguments: of the command.
        checkpoint: to begin from, or a folder of checkpoints.
        begin: returns the folder of the run, and its configuration, from that of the run that the checkpoint is of.
        finish: whether only the files of a complete run are to be written.
    """
    stopwatch = Stopwatch()
    folder = RunFolder(arguments.run)
    config = read_folder(folder)
    if config.backend != "ray" and (arguments.ray is not None or arguments.env_cpus is not None):
        raise ValueError(f"{folder.path} is no sweep and no run with --backend ray; --ray and --env-cpus are for these")
    require(config.log)
    device = arguments.device or ("cpu" if config.device == "cpu" else "auto")  # a GPU may not be here
    devices.start_with("--device", device)
    kind = agent_of_file(config.algorithm, folder.config)
    environment = environments.from_run(config, folder.path, arguments)
    ray = {"address": arguments.ray, "num_cpus": arguments.env_cpus} if config.backend == "ray" else None
    workers = WorkerOptions(restart_workers=arguments.restart_workers, wait_for=config.wait_for, ray=ray)
    with closing(environment.vector(config.n_envs, config.backend, config.seed, workers)) as env:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "resumed at step", UserWarning)  # printed below
            agent = kind.resume(checkpoint, env, device=device, **changes(arguments, config))
        limits = choose_limits(agent, arguments, finish)
        before = config
        if arguments.hyperparameters:
            config = dataclasses.replace(config, hyperparameters=configs.to_json(agent.config))
        folder, config = begin(agent, config)
        if config is not before:
            configs_of_runs.write(folder.config, config)
        echo(f"run folder    {folder.path}: {environment}, {config.algorithm}, seed {config.seed}")
        echo(f"checkpoint    {agent.resumed}")
        with closing(make_evaluation_env(config, environment)) as evaluation_env, Interrupt() as stop:
            session = Session(
                agent,
                config,
                folder,
                environment,
                evaluation_env,
                limits,
                is_new=False,
                has_report=not arguments.no_report,
                has_video=not arguments.no_video,
            )
            return session.run(stop, stopwatch)


def changes(arguments: Continued, config: DecidedRun) -> dict[str, Any]:
    """Returns the hyperparameters that ``--set`` changes."""
    names = {name.split(".")[0] for name in arguments.hyperparameters}
    changed = merged(arguments.hyperparameters, config.hyperparameters)
    return {name: value for name, value in changed.items() if name in names}


def is_evaluated(run: Path, agent: Agent) -> bool:
    """Returns whether the evaluation at the end of a run was not interrupted."""
    return agent.num_timesteps in read_table(RunFolder(run).evaluations, ("step",)).column("step")


def choose_limits(agent: Agent, arguments: Continued, finish: bool) -> TrainingLimits:
    """Returns how far to train: to the goal of the run, to a pause before it, or further than it.

    Raises:
        ValueError: if the run is complete and the arguments do not say how much further.
    """
    steps, minutes = arguments.steps, arguments.minutes
    if has_reached_goal(agent):
        if finish or (steps is None and minutes is None and not is_evaluated(arguments.run, agent)):
            return TrainingLimits()
        if steps is None and minutes is None:
            raise ValueError(
                f"the run is complete after {agent.num_timesteps:,} steps; give --steps N, or --minutes M, to train further"
            )
        return TrainingLimits(steps, minutes)
    assert agent.training_call is not None
    last = agent.training_call.last_step
    if steps is not None and last is not None and agent.run.step + steps > last:
        return TrainingLimits(steps)
    return TrainingLimits(pause_steps=steps, pause_minutes=minutes)
