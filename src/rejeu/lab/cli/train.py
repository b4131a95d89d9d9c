"""``rejeu train``: from the id of an environment to a run folder with a trained agent, a learning curve and a video.

The command line decides, then the preset of the environment, then the defaults.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from rejeu.agents import AGENTS, OffPolicyAgent, choose_algorithm, find_agent, find_preset, presets
from rejeu.agents.presets import Preset
from rejeu.algorithms import config as configs
from rejeu.algorithms.catalog import OFFLINE
from rejeu.checkpoints.run_folder import RunFolder, check_free
from rejeu.core import devices, validation
from rejeu.core.interrupt import Interrupt
from rejeu.core.spaces import leaves
from rejeu.envs.make import VectorEnv, WorkerOptions, make_vector
from rejeu.envs.registry import ENVPOOL_SIZE, is_envpool_installed, provider, register
from rejeu.lab.cli import check, environment, sweep
from rejeu.lab.cli.commands import Train
from rejeu.lab.cli.environment import Environment
from rejeu.lab.cli.output import Stopwatch, echo, header
from rejeu.lab.cli.session import Session, TrainingLimits, installed_logs, make_evaluation_env
from rejeu.lab.runs.config import DecidedRun, merged

MANY = 64
"""Number of environments from which an algorithm's values for many environments are used."""


def run_train(arguments: Train) -> tuple[int, dict[str, Any]]:
    """Trains; the exit status is 0, 2 if something could not be written, 130 after Ctrl-C, 143 after SIGTERM."""
    if arguments.offline is not None:
        arguments = with_dataset(arguments)
    if arguments.seeds is not None:
        return sweep.train_together(arguments, begin) if sweep.fit_together(arguments) else sweep.train_all(arguments)
    stopwatch = Stopwatch()
    with ExitStack() as stack:
        session, stop = begin(arguments, stack), stack.enter_context(Interrupt())
        if arguments.assist:
            from rejeu.teaching.play import assist

            assist.check(session.agent)
        session = session.in_new_folder(arguments.out)
        if arguments.assist:
            session = session._replace(more=(assist.Assist(session.folder.path / "assisted", fps=arguments.fps),))
        echo(header(session.config, session.environment, session.backend, session.folder))
        return session.run(stop, stopwatch)


def with_dataset(arguments: Train) -> Train:
    """Returns the arguments with ``--offline`` as the hyperparameters that it stands for.

    Raises:
        ValueError: if the algorithm does not learn from a replay buffer.
    """
    name = arguments.algorithm or (OFFLINE if arguments.preset is None else None)
    if name is not None and not issubclass(find_agent(name), OffPolicyAgent):
        raise ValueError(f"--offline needs an algorithm with a replay buffer, such as {OFFLINE}; {name} has none")
    given = {"demonstrations": str(arguments.offline), "offline": True}
    return replace(arguments, algorithm=name, hyperparameters={**arguments.hyperparameters, **given}, offline=None)


def begin(arguments: Train, stack: ExitStack) -> Session:
    """Returns the session of a new run, for which there is no folder yet; ``stack`` closes its environments."""
    devices.start_with("--device", arguments.device)
    check_free(arguments.out)
    seed = int(np.random.default_rng().integers(10_000)) if arguments.seed is None else arguments.seed
    logs = installed_logs(arguments)
    algorithm = None if arguments.algorithm is None else find_agent(arguments.algorithm).algorithm.Config.name
    made = environment.from_arguments(arguments.env, arguments)
    preset = find_preset(made.env_id, algorithm, None if arguments.preset is None else str(arguments.preset))
    env = stack.enter_context(closing(make_env(arguments, made, preset, seed)))
    is_long = arguments.is_long and not arguments.hyperparameters and env.n_envs < MANY
    algorithm = algorithm or choose_algorithm(preset, env.env_id, env.observation_space, env.action_space, is_long)
    config = make_config(arguments, made, preset, algorithm, env, seed, logs)
    general: dict[str, Any] = {"seed": seed, "success_threshold": config.success_threshold, "device": config.device}
    agent = AGENTS[algorithm](config.policy, env, **general, **config.hyperparameters)
    if env.backend not in ("envpool", "jax"):
        check.before_training(made, agent.config)
    return Session(
        agent,
        config,
        RunFolder(Path()),
        made,
        stack.enter_context(closing(make_evaluation_env(config, made))),
        TrainingLimits(config.steps, config.minutes, pause_steps=arguments.pause),
        is_new=True,
        has_report=not arguments.no_report,
        has_video=not arguments.no_video,
        backend=describe_backend(env, made, preset),
    )


def make_env(arguments: Train, made: Environment, preset: Preset | None, seed: int) -> VectorEnv:
    """Returns the training environments."""
    if arguments.assist:
        return make_vector(made.rendering, 1, "gymnasium", seed)
    n_envs = arguments.n_envs or (preset.n_envs if preset else 1)
    backend = preset.backend if preset and made.is_plain else "auto"
    if backend == "envpool" and not is_envpool_installed() and (register(made.env_id) or provider(made.env_id)):
        backend = "gymnasium"
    backend = arguments.backend or backend
    workers = WorkerOptions(restart_workers=arguments.restart_workers, wait_for=arguments.wait_for)
    if backend == "ray" or arguments.ray is not None:
        workers = workers._replace(ray={"address": arguments.ray, "num_cpus": arguments.env_cpus})
    return made.vector(n_envs, backend, seed, workers)


def describe_backend(env: VectorEnv, made: Environment, preset: Preset | None) -> str:
    """Returns the backend, with a hint if the preset uses EnvPool and that is not installed."""
    is_slower = env.backend == "gymnasium" and made.is_plain and preset is not None and preset.backend == "envpool"
    if not is_slower or is_envpool_installed():
        return env.backend
    return f'{env.backend}; EnvPool would be faster ({ENVPOOL_SIZE}): pip install "rejeu[envpool]"'


def untuned(algorithm: str, env: VectorEnv) -> Mapping[str, Any]:
    """Returns the hyperparameters of an algorithm in environments without a preset."""
    config = AGENTS[algorithm].algorithm.Config
    if env.n_envs >= MANY:
        return config.for_many
    return {} if any(leaf.kind == "image" for leaf in leaves(env.observation_space)) else presets.small(algorithm)


def make_config(
    arguments: Train,
    made: Environment,
    preset: Preset | None,
    algorithm: str,
    env: VectorEnv,
    seed: int,
    logs: tuple[str, ...],
) -> DecidedRun:
    """Returns the configuration of the run: the arguments, then the preset, then the defaults.

    Raises:
        TypeError: for an unknown hyperparameter, with the nearest known one.
        ValueError: for an invalid value.
    """
    base = presets.default(made.env_id, algorithm, untuned(algorithm, env)) if preset is None else preset
    hyperparameters = merged(arguments.hyperparameters, base.hyperparameters)
    config = validation.build(AGENTS[algorithm].algorithm.Config, hyperparameters)
    nested = isinstance(env.observation_space, spaces.Dict | spaces.Tuple)
    return DecidedRun(
        env=made.env_id,
        env_argument=made.run.env,
        env_kwargs=dict(made.run.env_kwargs),
        wrappers=made.run.wrappers,
        imports=made.run.imports,
        algorithm=algorithm,
        preset=preset is not None,
        hyperparameters=configs.to_json(config),
        policy="MultiInputPolicy" if nested else "MlpPolicy",
        seed=seed,
        n_envs=env.n_envs,
        backend=env.backend,
        wait_for=env.wait_for,
        device=devices.named(arguments.device, "--device"),
        steps=None if arguments.minutes is not None else arguments.steps or base.total_steps,
        minutes=arguments.minutes,
        success_threshold=base.success_threshold
        if arguments.success_threshold is None
        else arguments.success_threshold,
        video_every=arguments.video_every,
        evaluate_every=arguments.evaluate_every or base.evaluate_every,
        evaluate_episodes=arguments.evaluate_episodes or base.evaluate_episodes,
        checkpoint_minutes=arguments.checkpoint_minutes or None,
        keep_checkpoints=arguments.keep_checkpoints,
        log=logs,
    )
