"""``rejeu resume``: continues a run that was stopped, exactly where it stood, or trains a complete one further."""

from __future__ import annotations

import warnings
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from rejeu.cli import run_folder
from rejeu.cli.environment import RunOptions
from rejeu.cli.run_folder import RunFolder
from rejeu.cli.running import Limits, Session, Watch, carry_out, has_reached_goal, make_evaluation_env
from rejeu.cli.telling import say
from rejeu.interrupt import Interrupt

if TYPE_CHECKING:
    from rejeu.agents import Agent


@dataclass(frozen=True)
class Resume(RunOptions):
    """Resumes a run that was stopped, or that died, from its newest checkpoint.

    Without --steps or --minutes it trains to the goal that was set when it began. Example: rejeu resume runs/NAME
    """

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Its folder."""
    steps: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Pause after so many environment steps; the goal stays. Of a complete run, or beyond the goal: train so many more."""
    minutes: Annotated[float | None, arg(metavar="M", help_behavior_hint="")] = None
    """Pause after so many minutes; the goal stays. Of a complete run: train for so many more."""


def run(arguments: Resume) -> int:
    """Trains and returns the exit status, as ``rejeu train`` does."""
    watch = Watch()
    from rejeu import AGENTS
    from rejeu.errors import CheckpointError
    from rejeu.validation import number, whole

    if arguments.steps is not None and arguments.minutes is not None:
        raise ValueError("--steps and --minutes exclude each other; give one of them")
    if arguments.steps is not None:
        whole("--steps", arguments.steps, least=1)
    if arguments.minutes is not None:
        number("--minutes", arguments.minutes, above=0)
    folder = RunFolder(arguments.run)
    config = run_folder.read_config(folder)
    if config.algorithm not in AGENTS:
        raise CheckpointError(f"{folder.config} names the algorithm {config.algorithm[:40]!r}, which is unknown")
    environment = run_folder.of_run(folder, config, arguments)
    with closing(environment.vector(config.n_envs, config.backend, config.seed)) as env:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "resumed at step", UserWarning)  # printed below
            agent = AGENTS[config.algorithm].resume(folder.checkpoints, env)
        limits = choose_limits(agent, arguments)
        say(f"run folder    {folder.path}: {environment}, {config.algorithm}, seed {config.seed}")
        say(f"checkpoint    {agent.resumed}")
        with closing(make_evaluation_env(config, environment)) as evaluation_env, Interrupt() as stop:
            session = Session(agent, config, folder, environment, evaluation_env, limits, is_new=False)
            return carry_out(session, stop, watch)


def choose_limits(agent: Agent, arguments: Resume) -> Limits:
    """Returns how far to train: to the goal of the run, to a pause before it, or further than it.

    Raises:
        ValueError: if the run is complete and the arguments do not say how much further.
    """
    steps, minutes = arguments.steps, arguments.minutes
    if has_reached_goal(agent):
        if steps is None and minutes is None:
            raise ValueError(
                f"the run is complete after {agent.num_timesteps:,} steps; to train further: rejeu resume {arguments.run} "
                "--steps N, or --minutes M"
            )
        return Limits(steps, minutes)
    assert agent._call is not None
    last = agent._call.last_step
    if steps is not None and last is not None and agent.run.step + steps > last:
        return Limits(steps)
    return Limits(pause_steps=steps, pause_minutes=minutes)
