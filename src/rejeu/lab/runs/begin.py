"""How a run begins: from what is asked of it to environments, configuration and agent.

What was typed decides, then the preset of the environment, then the defaults.
"""

from __future__ import annotations

import random
import sys
from collections.abc import Mapping
from contextlib import ExitStack, chdir, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rejeu.agents import AGENTS, OffPolicyAgent, choose_algorithm, find_agent, find_preset, presets
from rejeu.agents.presets import Preset
from rejeu.algorithms import config as configs
from rejeu.algorithms.catalog import OFFLINE
from rejeu.checkpoints.run_folder import RunFolder, check_free
from rejeu.core import devices, validation
from rejeu.core.errors import BadEnvironmentError
from rejeu.core.spaces import leaves
from rejeu.core.types import Settings
from rejeu.envs.make import VectorEnv, WorkerOptions, make_vector
from rejeu.envs.registry import ENVPOOL_SIZE, has_package, is_envpool_installed, usable_envpool
from rejeu.lab.runs.arguments import Train
from rejeu.lab.runs.config import DecidedRun, RunConfig, merged
from rejeu.lab.runs.environment import Environment, from_arguments, module_of
from rejeu.lab.runs.session import Report, Session, TrainingLimits, installed_logs, make_evaluation_env
from rejeu.logs.formatting import counted

MANY = 64
"""Number of environments from which an algorithm's values for many environments are used."""


def begin(arguments: Train, stack: ExitStack, report: Report) -> Session:
    """Returns the session of a new run, without a folder; ``stack`` closes its environments, ``report`` writes its page."""
    devices.start_with("--device", arguments.device)
    check_free(arguments.out)
    seed = int(np.random.default_rng().integers(10_000)) if arguments.seed is None else arguments.seed
    logs = installed_logs(arguments)
    algorithm = None if arguments.algorithm is None else find_agent(arguments.algorithm).algorithm.Config.name
    environment = from_arguments(arguments.env, arguments)
    preset = find_preset(environment.env_id, algorithm, None if arguments.preset is None else str(arguments.preset))
    env = stack.enter_context(closing(make_env(arguments, environment, preset, seed)))
    config = make_config(replace(arguments, algorithm=algorithm), environment, preset, env, seed, logs)
    general: Settings = {"seed": seed, "success_threshold": config.success_threshold, "device": config.device}
    agent = AGENTS[config.algorithm](config.policy, env, **general, **config.hyperparameters)
    if env.backend not in ("envpool", "jax"):
        check_own_environment(environment, agent.config)
    evaluation_env = stack.enter_context(closing(make_evaluation_env(config, environment)))
    limits = TrainingLimits(config.steps, config.minutes, pause_steps=arguments.pause)
    run = agent, config, RunFolder(Path()), environment, evaluation_env, limits
    outputs = None if arguments.no_report else report, not arguments.no_video
    return Session(*run, True, *outputs, describe_backend(env, environment, preset))


def make_env(arguments: Train, environment: Environment, preset: Preset | None, seed: int) -> VectorEnv:
    """Returns the training environments."""
    if arguments.assist:
        return make_vector(environment.rendering, 1, "gymnasium", seed)
    n_envs = arguments.n_envs or (preset.n_envs if preset else 1)
    backend = arguments.backend or (preset.backend if preset and environment.is_plain else "auto")
    if backend == "envpool" != arguments.backend and usable_envpool() is None and has_package(environment.env_id):
        backend = "gymnasium"
    workers = WorkerOptions(restart_workers=arguments.restart_workers)
    if backend == "ray" or arguments.ray is not None:
        workers = workers._replace(ray={"address": arguments.ray, "num_cpus": arguments.env_cpus})
    return environment.vector(n_envs, backend, seed, workers)


def describe_backend(env: VectorEnv, environment: Environment, preset: Preset | None) -> str:
    """Returns the backend, with a hint if the preset uses EnvPool and that is not installed."""
    is_slower = env.backend == "gymnasium" and environment.is_plain and preset and preset.backend == "envpool"
    twin = next((f", or train {name}" for name, env_id in presets.TWINS.items() if env_id == environment.env_id), "")
    hint = f'; EnvPool would be faster ({ENVPOOL_SIZE}): pip install "rejeu[envpool]"{twin}'
    return env.backend + (hint if is_slower and not is_envpool_installed() else "")


def decide(
    run: RunConfig, preset: Preset | None, observations: gym.Space, actions: gym.Space, is_long: bool
) -> tuple[Preset, configs.AlgorithmConfig]:
    """Returns the preset, else the defaults, and the configuration of the algorithm: what ``run`` asks for, then these.

    ``run`` has the id of its environment. With ``is_long`` the algorithm may be one for long runs.

    Raises:
        TypeError: for an unknown hyperparameter, with the nearest known one.
        ValueError: for an invalid value, or if no algorithm takes the actions.
    """
    n_envs = run.n_envs or (preset.n_envs if preset else 1)
    is_long = is_long and n_envs < MANY
    algorithm = run.algorithm or choose_algorithm(preset, run.env, observations, actions, is_long)
    base = preset or presets.default(run.env, algorithm, untuned(algorithm, n_envs, observations))
    hyperparameters = merged(run.hyperparameters, base.hyperparameters)
    return base, validation.build(AGENTS[algorithm].algorithm.Config, hyperparameters)


def untuned(algorithm: str, n_envs: int, observations: gym.Space) -> Mapping[str, object]:
    """Returns the hyperparameters of an algorithm in environments without a preset."""
    if n_envs >= MANY:
        return AGENTS[algorithm].algorithm.Config.for_many
    return {} if any(leaf.kind == "image" for leaf in leaves(observations)) else presets.small(algorithm)


def make_config(
    arguments: Train, environment: Environment, preset: Preset | None, env: VectorEnv, seed: int, logs: tuple[str, ...]
) -> DecidedRun:
    """Returns the configuration of the run: the arguments, then the preset, then the defaults; raises as :func:`decide`."""
    run = replace(arguments, env=environment.env_id, n_envs=env.n_envs)
    is_long = run.is_long and not run.hyperparameters
    base, config = decide(run, preset, env.observation_space, env.action_space, is_long)
    nested = isinstance(env.observation_space, spaces.Dict | spaces.Tuple)
    return DecidedRun(
        env=environment.env_id,
        env_argument=environment.run.env,
        env_kwargs=dict(environment.run.env_kwargs),
        wrappers=environment.run.wrappers,
        imports=environment.run.imports,
        algorithm=config.name,
        preset=preset is not None,
        hyperparameters=configs.to_json(config),
        policy="MultiInputPolicy" if nested else "MlpPolicy",
        seed=seed,
        n_envs=env.n_envs,
        backend=env.backend,
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


def with_dataset(arguments: Train) -> Train:
    """Returns the arguments with ``--offline`` as the hyperparameters that it stands for.

    Raises:
        ValueError: if the algorithm does not learn from a replay buffer.
    """
    name = arguments.algorithm or (OFFLINE if arguments.preset is None else None)
    if name is not None and not issubclass(find_agent(name), OffPolicyAgent):
        raise ValueError(f"--offline needs an algorithm with a replay buffer, such as {OFFLINE}; {name} has none")
    dataset = {"demonstrations": str(arguments.offline), "offline": True}
    return replace(arguments, algorithm=name, hyperparameters={**arguments.hyperparameters, **dataset}, offline=None)


def check_own_environment(environment: Environment, config: Any) -> None:
    """Prints the errors of an environment of one's own, and warns of episodes that never end; ``config`` is the algorithm's.

    A new environment takes some steps; random numbers of NumPy and Python, and the current folder, are as before.

    Raises:
        BadEnvironmentError: if there are errors.
    """
    if not is_own(environment):
        return
    from rejeu.envs import checker

    states = random.getstate(), np.random.get_state()  # noqa: NPY002 - of other code
    with chdir("."), closing(environment.make()) as env:
        keeps_infos = getattr(getattr(config, "hindsight", None), "copy_info_dict", False)
        findings = sorted(checker.quick_findings(env, keeps_infos))
    random.setstate(states[0])
    np.random.set_state(states[1])  # noqa: NPY002
    if errors := checker.errors_of(findings):
        print("\n".join(f"error: {text}" for text in errors), file=sys.stderr)
        raise BadEnvironmentError(
            f"{environment.run.env} has {counted(len(errors), 'error')}, so nothing is trained; rejeu check shows its "
            "warnings too"
        )


def is_own(environment: Environment) -> bool:
    """Returns whether the code of an environment or of a wrapper is not that of an installed package."""
    spec = gym.registry.get(environment.env_id)
    entries = [] if spec is None else [spec.entry_point, *(wrapper.entry_point for wrapper in spec.additional_wrappers)]
    modules = [module_of(entry_point) for entry_point in (*entries, *environment.wrappers)]
    return any(module is not None and not is_installed(module) for module in modules)


def is_installed(module: str) -> bool:
    """Returns whether a module is part of an installed package, or not imported yet, which those of one's own are."""
    package = module.partition(".")[0]
    imported = sys.modules.get(package)
    if imported is None or package == "rejeu":
        return True
    paths = [getattr(imported, "__file__", None), *getattr(imported, "__path__", ())]
    return any({"site-packages", "dist-packages"} & {*Path(path).resolve().parts} for path in paths if path)
