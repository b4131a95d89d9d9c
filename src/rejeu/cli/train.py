"""``rejeu train``: from the name of an environment to a run folder with a trained agent, a curve and a video."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, UseAppendAction, arg

from rejeu.cli import run_folder, settings
from rejeu.cli.environment import Environment, EnvironmentOptions, named
from rejeu.cli.run_folder import RunConfig
from rejeu.cli.running import Limits, Session, Watch, carry_out, make_agent, make_evaluation_env
from rejeu.cli.telling import header, say
from rejeu.interrupt import Interrupt

if TYPE_CHECKING:
    from rejeu.envs.make import VectorEnv
    from rejeu.presets import Preset


@dataclass(frozen=True)
class Train(EnvironmentOptions):
    """Trains an agent and leaves a run folder: models, tables, learning curve, video.

    Ctrl-C stops cleanly; rejeu resume goes on. Example: rejeu train Pendulum-v1 --steps 20000 --set learning_rate=1e-3
    """

    env: Annotated[Positional[str], arg(metavar="ENV")]
    """Id of an environment, such as parking-v0; or my_env:MyEnv-v0 or my_env.py, which is imported."""
    algo: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """Algorithm; by default the preset's, else the one that fits the environment's actions."""
    steps: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Environment steps to take, over all environments; by default the preset's, else 100000."""
    minutes: Annotated[float | None, arg(metavar="M", help_behavior_hint="")] = None
    """Train for so many minutes instead."""
    envs: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Environments stepped at once; by default the preset's, else 1."""
    backend: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """auto, envpool, gymnasium or gymnasium-async; by default the preset's, else auto: the fastest, measured once."""
    restart_workers: Annotated[int, arg(metavar="N")] = 0
    """With --backend gymnasium-async: how many worker processes that crashed or hung are started anew."""
    seed: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Seeds everything; one is drawn if none is given."""
    assignments: Annotated[tuple[tuple[str, ...], ...], UseAppendAction, arg(name="set", metavar="NAME=VALUE ...")] = ()
    """Hyper-parameters, dotted where nested: policy_kwargs.net_arch=[64,64] train_freq=[1,"episode"]."""
    out: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Run folder, new or empty; by default one under runs, named after the run and the time."""
    success_threshold: Annotated[float | None, arg(metavar="RETURN", help_behavior_hint="")] = None
    """Return from which on an episode counts as a success; by default what the environment says or declares."""
    film_every: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Film an episode of the policy every so many environment steps, into the folder films."""
    checkpoint_minutes: Annotated[float, arg(metavar="M", help_behavior_hint="(default: 5)")] = 5.0
    """Minutes between two checkpoints, from which rejeu resume goes on; 0 for none."""
    evaluate_every: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Environment steps between two evaluations; by default the preset's, else 5000."""
    evaluate_episodes: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Episodes of each evaluation; by default the preset's, else 20."""


def run(arguments: Train) -> int:
    """Trains and returns the exit status: 0, 2 if something could not be written, 130 after Ctrl-C, 143 after SIGTERM."""
    watch = Watch()
    from rejeu import presets
    from rejeu.envs.measuring import sentence

    check(arguments)
    algorithm = None if arguments.algo is None else algorithm_name(arguments.algo)
    environment = named(arguments.env, arguments)
    preset = presets.find(environment.env_id, algorithm)
    seed = draw_seed() if arguments.seed is None else arguments.seed
    with closing(make_env(arguments, environment, preset, seed)) as env:
        config = plan(arguments, environment, preset, algorithm or choose_algorithm(preset, env), env, seed)
        agent = make_agent(config, env)
        with closing(make_evaluation_env(config, environment)) as evaluation_env, Interrupt() as stop:
            folder = run_folder.create(arguments.out, config.env, config.algorithm, seed)
            run_folder.write_config(folder, config)
            say(header(config, environment, sentence(env), folder))
            limits = Limits(config.steps, config.minutes)
            session = Session(agent, config, folder, environment, evaluation_env, limits, is_new=True)
            return carry_out(session, stop, watch)


def make_env(arguments: Train, environment: Environment, preset: Preset | None, seed: int) -> VectorEnv:
    """Returns the environments to train on."""
    n_envs = arguments.envs or (preset.n_envs if preset else 1)
    usual = preset.backend if preset and environment.is_plain else "auto"
    return environment.vector(n_envs, arguments.backend or usual, seed, arguments.restart_workers)


def check(arguments: Train) -> None:
    """Raises ValueError or OSError for what is wrong before anything is made."""
    from rejeu.agents import whole_seed
    from rejeu.io.records import MAX_ENVS
    from rejeu.validation import number, whole

    if arguments.steps is not None and arguments.minutes is not None:
        raise ValueError("--steps and --minutes exclude each other; give one of them")
    most = {"envs": MAX_ENVS, "evaluate_episodes": run_folder.MAX_EPISODES}
    for name in ("steps", "envs", "film_every", "evaluate_every", "evaluate_episodes"):
        if getattr(arguments, name) is not None:
            whole(f"--{name.replace('_', '-')}", getattr(arguments, name), least=1, most=most.get(name, 2**63 - 1))
    if arguments.minutes is not None:
        number("--minutes", arguments.minutes, above=0)
    number("--checkpoint-minutes", arguments.checkpoint_minutes, least=0)
    if arguments.success_threshold is not None:
        number("--success-threshold", arguments.success_threshold)
    if arguments.seed is not None:
        whole_seed(arguments.seed)
    run_folder.check_free(arguments.out)


def algorithm_name(given: str) -> str:
    """Returns the name of an algorithm in its own spelling.

    Raises:
        ValueError: if there is none of that name.

    >>> algorithm_name("sac")
    'SAC'
    """
    import difflib

    from rejeu import AGENTS

    known = {name.lower(): name for name in AGENTS}
    if given.lower() in known:
        return known[given.lower()]
    near = difflib.get_close_matches(given.lower(), known, n=1, cutoff=0.5)
    hint = f"did you mean {known[near[0]]}?" if near else f"there are {', '.join(AGENTS)}"
    raise ValueError(f"no algorithm is called {given!r}; {hint}")


def draw_seed() -> int:
    """Returns a seed of at most four digits, which a person can copy."""
    import numpy as np

    return int(np.random.default_rng().integers(10_000))


def choose_algorithm(preset: Preset | None, env: VectorEnv) -> str:
    """Returns the preset's algorithm, or one that takes the environment's actions.

    Raises:
        ValueError: if there is none.
    """
    from rejeu import presets

    if preset is not None:
        return preset.algorithm
    kind = type(env.action_space).__name__
    if kind not in presets.ALGORITHM_FOR:
        known = ", ".join(f"{name} takes {space}" for space, name in presets.ALGORITHM_FOR.items())
        raise ValueError(f"{env.env_id} has the actions {env.action_space}, which no algorithm here takes; {known}")
    return presets.ALGORITHM_FOR[kind]


def plan(
    arguments: Train, environment: Environment, preset: Preset | None, algorithm: str, env: VectorEnv, seed: int
) -> RunConfig:
    """Returns what will be done: what the arguments say, and where they are silent the preset or the defaults.

    Raises:
        TypeError: for an unknown hyper-parameter, with the nearest known one.
        ValueError: for a bad value.
    """
    from gymnasium import spaces

    from rejeu import AGENTS, presets, validation
    from rejeu.algorithms import config as configs

    base = presets.default(environment.env_id, algorithm) if preset is None else preset
    given = settings.apply(chain.from_iterable(arguments.assignments), base.hyperparameters)
    nested = isinstance(env.observation_space, spaces.Dict | spaces.Tuple)
    return RunConfig(
        env=environment.env_id,
        env_argument=environment.typed,
        env_kwargs=dict(environment.kwargs),
        wrappers=environment.wrapper_names,
        algorithm=algorithm,
        preset=preset is not None,
        hyperparameters=configs.to_json(validation.build(AGENTS[algorithm].algorithm.Config, given)),
        policy="MultiInputPolicy" if nested else "MlpPolicy",
        seed=seed,
        n_envs=env.n_envs,
        backend=env.backend,
        steps=None if arguments.minutes is not None else arguments.steps or base.total_steps,
        minutes=arguments.minutes,
        success_threshold=arguments.success_threshold,
        film_every=arguments.film_every,
        evaluate_every=arguments.evaluate_every or base.evaluate_every,
        evaluate_episodes=arguments.evaluate_episodes or base.evaluate_episodes,
        checkpoint_minutes=arguments.checkpoint_minutes or None,
    )
