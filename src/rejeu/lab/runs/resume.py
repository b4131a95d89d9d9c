"""How a run goes on from a checkpoint: exactly where it was stopped, or further than it was asked to before."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from rejeu.agents import Agent, agent_of_file
from rejeu.algorithms import config as configs
from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core import devices
from rejeu.core.errors import RunInUseError
from rejeu.core.interrupt import Interrupt
from rejeu.core.types import JsonObject, Settings
from rejeu.envs.make import WorkerOptions
from rejeu.lab.runs import config as configs_of_runs, environment as environments
from rejeu.lab.runs.arguments import Continued, Resume
from rejeu.lab.runs.config import DecidedRun, merged, read_folder
from rejeu.lab.runs.output import Stopwatch, echo
from rejeu.lab.runs.read import is_locked
from rejeu.lab.runs.requests import drop
from rejeu.lab.runs.session import Report, Session, TrainingLimits, has_reached_goal, make_evaluation_env
from rejeu.logs.logging import require
from rejeu.logs.tables import read_table


def resume(arguments: Resume, report: Report) -> tuple[int, JsonObject]:
    """Trains a run on from its newest checkpoint; the exit status and the result are those of :meth:`Session.run`.

    Raises:
        RunInUseError: if another process trains there.
    """
    folder = RunFolder(arguments.run)
    if is_locked(folder.lock):  # before the request to the other process is removed
        raise RunInUseError(f"another process is training in {folder.path}; wait for it, or stop it")
    drop(folder.stop)  # a later one is for this process
    return train_on(arguments, folder.checkpoints, report, lambda agent, config: (folder, config), arguments.finish)


def train_on(
    arguments: Continued,
    checkpoint: Path,
    report: Report,
    begin: Callable[[Agent, DecidedRun], tuple[RunFolder, DecidedRun]],
    finish: bool = False,
) -> tuple[int, JsonObject]:
    """Trains; returns the exit status and the result.

    Args:
        arguments: of the command.
        checkpoint: to begin from, or a folder of checkpoints.
        report: writes the page of the run at the end, unless ``no_report`` is set.
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
    agent_class = agent_of_file(config.algorithm, folder.config)
    environment = environments.from_run(config, folder.path, arguments)
    ray = {"address": arguments.ray, "num_cpus": arguments.env_cpus} if config.backend == "ray" else None
    workers = WorkerOptions(restart_workers=arguments.restart_workers, ray=ray)
    with closing(environment.vector(config.n_envs, config.backend, config.seed, workers)) as env:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "resumed at step", UserWarning)  # printed below
            agent = agent_class.resume(checkpoint, env, device=device, **changes(arguments, config))
        limits = choose_limits(agent, arguments, finish)
        before = config
        if arguments.hyperparameters:
            config = dataclasses.replace(config, hyperparameters=configs.to_json(agent.config))
        folder, config = begin(agent, config)
        agent.checkpoint_folder(folder.checkpoints).lock()
        if config is not before:
            configs_of_runs.write(folder.config, config)
        echo(f"run folder    {folder.path}: {environment}, {config.algorithm}, seed {config.seed}")
        echo(f"checkpoint    {agent.resumed}")
        with closing(make_evaluation_env(config, environment)) as evaluation_env, Interrupt() as stop:
            run = agent, config, folder, environment, evaluation_env, limits
            outputs = None if arguments.no_report else report, not arguments.no_video
            return Session(*run, False, *outputs).run(stop, stopwatch)


def changes(arguments: Continued, config: DecidedRun) -> Settings:
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
    assert agent.call.training_call is not None
    last = agent.call.training_call.last_step
    if steps is not None and last is not None and agent.run.step + steps > last:
        return TrainingLimits(steps)
    return TrainingLimits(pause_steps=steps, pause_minutes=minutes)
