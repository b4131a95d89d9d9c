"""``rejeu resume``: goes on with a run that was stopped, exactly where it stood, or trains a complete one further."""

from __future__ import annotations

import warnings
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from rejeu.cli import run_folder, train
from rejeu.cli.run_folder import RunFolder
from rejeu.cli.train import Limits, Watch, say


@dataclass(frozen=True)
class Resume:
    """Goes on with a run that was stopped, or that died, from its newest checkpoint.

    Without --steps or --minutes it goes on to the end that was set when it began. Example: rejeu resume runs/NAME
    """

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Its folder."""
    steps: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Take so many environment steps from here instead."""
    minutes: Annotated[float | None, arg(metavar="M", help_behavior_hint="")] = None
    """Train for so many minutes from here instead."""


def run(arguments: Resume) -> int:
    """Trains and returns the exit status, as ``rejeu train`` does."""
    watch = Watch()
    from rejeu import AGENTS
    from rejeu.config import number, whole
    from rejeu.envs.vector import make_vector
    from rejeu.errors import CheckpointError

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
    with closing(make_vector(config.env, config.n_envs, config.backend, config.seed)) as env:  # type: ignore[arg-type]
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "resumed at step", UserWarning)  # printed below
            agent = AGENTS[config.algorithm].resume(folder.checkpoints, env)
        say(f"run folder    {folder.path}: {config.env}, {config.algorithm}, seed {config.seed}")
        say(f"checkpoint    {agent.resumed}")
        with closing(train.make_evaluation_env(config)) as evaluation_env:
            limits = Limits(arguments.steps, arguments.minutes)
            evaluate = train.train(agent, config, evaluation_env, folder, limits, anew=False)
            return train.finish(agent, config, folder, evaluate, watch)
