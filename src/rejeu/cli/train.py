"""``rejeu train``: from the id of an environment to a run folder with a trained agent, a learning curve and a video."""

from __future__ import annotations

from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np

from rejeu import devices
from rejeu.agents import AGENTS, find_agent
from rejeu.cli import check, choices, environment, jsonout, seeds, together
from rejeu.cli.commands import Train
from rejeu.cli.output import Stopwatch, echo, header
from rejeu.cli.session import Limits, Session, make_evaluation_env
from rejeu.interrupt import Interrupt
from rejeu.runs import config as configs
from rejeu.runs.folder import RunFolder, check_free, create


def run(arguments: Train) -> int:
    """Trains and returns the exit status: 0, 2 if something could not be written, 130 after Ctrl-C, 143 after SIGTERM."""
    if arguments.seeds is None:
        return jsonout.run(train, arguments)
    if together.is_possible(arguments):
        return jsonout.run(lambda arguments: together.train_all(arguments, begin), arguments)
    return seeds.run(arguments)


def train(arguments: Train) -> tuple[int, dict[str, Any]]:
    """Trains; returns the exit status and the result."""
    stopwatch = Stopwatch()
    devices.start_with("--device", arguments.device)
    check_free(arguments.out)
    seed = int(np.random.default_rng().integers(10_000)) if arguments.seed is None else arguments.seed
    with ExitStack() as stack:
        session, stop = begin(arguments, seed, stack), stack.enter_context(Interrupt())
        folder = create(arguments.out, session.config.env, session.config.algorithm, seed)
        session = session._replace(folder=folder)
        configs.write(folder.config, session.config)
        echo(header(session.config, session.environment, session.backend, folder))
        return session.run(stop, stopwatch)


def begin(arguments: Train, seed: int, stack: ExitStack) -> Session:
    """Returns the session of a new run, for which there is no folder yet; ``stack`` closes its environments."""
    logs = choices.installed_logs(arguments)
    algorithm = None if arguments.algorithm is None else find_agent(arguments.algorithm).algorithm.Config.name
    made = environment.from_arguments(arguments.env, arguments)
    preset = choices.find_preset(arguments, made, algorithm)
    env = stack.enter_context(closing(choices.make_env(arguments, made, preset, seed)))
    algorithm = algorithm or choices.choose_algorithm(preset, env)
    config = choices.make_config(arguments, made, preset, algorithm, env, seed, logs)
    general: dict[str, Any] = {"seed": seed, "success_threshold": config.success_threshold, "device": config.device}
    agent = AGENTS[algorithm](config.policy, env, **general, **config.hyperparameters)
    if env.backend not in ("envpool", "jax"):
        check.before_training(made)
    return Session(
        agent,
        config,
        RunFolder(Path()),
        made,
        stack.enter_context(closing(make_evaluation_env(config, made))),
        Limits(config.steps, config.minutes, pause_steps=arguments.pause),
        is_new=True,
        has_report=not arguments.no_report,
        has_video=not arguments.no_video,
        backend=choices.describe_backend(env, made, preset),
    )
