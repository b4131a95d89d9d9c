"""``rejeu train``: from the name of an environment to a run folder with a trained agent, a curve and a video."""

from __future__ import annotations

import math
import signal
import sys
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

from tyro.conf import Positional, UseAppendAction, arg

from rejeu.cli import run_folder, settings
from rejeu.cli.run_folder import RunConfig, RunFolder

if TYPE_CHECKING:
    from rejeu.agents import Agent
    from rejeu.callbacks import Evaluate, Evaluated
    from rejeu.envs.vector import VectorEnv
    from rejeu.logging import Sink
    from rejeu.presets import Preset

VIDEO_EPISODES = 3
VIDEO_STEPS = 600
"""Most steps filmed, for a poor policy's episodes are long and highway-env draws some 70 a second."""

say = partial(print, flush=True)


@dataclass(frozen=True)
class Train:
    """Trains an agent and leaves a run folder: models, tables, learning curve, video.

    Ctrl-C stops cleanly; rejeu resume goes on. Example: rejeu train Pendulum-v1 --steps 20000 --set learning_rate=1e-3
    """

    env: Annotated[Positional[str], arg(metavar="ENV")]
    """Id of an environment, such as parking-v0."""
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
    preset = presets.find(arguments.env, algorithm)
    seed = draw_seed() if arguments.seed is None else arguments.seed
    with closing(make_env(arguments, preset, seed)) as env:
        config = plan(arguments, preset, algorithm or choose_algorithm(preset, env), env, seed)
        agent = make_agent(config, env)
        with closing(make_evaluation_env(config)) as evaluation_env:
            folder = run_folder.create(arguments.out, config.env, config.algorithm, seed)
            run_folder.write_config(folder, config)
            say(header(config, sentence(env), folder))
            limits = Limits(config.steps, config.minutes)
            return finish(agent, config, folder, train(agent, config, evaluation_env, folder, limits), watch)


class Limits(NamedTuple):
    """What ends a run; None for both goes on with one that was cut off."""

    steps: int | None
    minutes: float | None


class Watch:
    """Measures what a command takes, from when it is made."""

    def __init__(self) -> None:
        from rejeu import compilation

        self._began, self._compiled = time.perf_counter(), compilation.seconds()

    def seconds(self) -> tuple[float, float]:
        """Returns wall time, and how much of it went into compiling."""
        from rejeu import compilation

        return time.perf_counter() - self._began, compilation.seconds() - self._compiled


def finish(agent: Agent, config: RunConfig, folder: RunFolder, evaluate: Evaluate, watch: Watch) -> int:
    """Draws and films what a run came to, says so and what could not be written, and returns the exit status."""
    written = agent.failed_writes.retry()
    picture(agent, evaluate, config, folder)
    say(summary(agent, evaluate, folder, *watch.seconds()))
    if failed := agent.failed_writes.summary():
        print(f"warning: {failed}", file=sys.stderr)
    if agent.interrupted_by is not None:
        return 128 + agent.interrupted_by
    return 0 if written else 2


def check(arguments: Train) -> None:
    """Raises ValueError or OSError for what is wrong before anything is made."""
    from rejeu.agents import whole_seed
    from rejeu.config import number, whole

    if arguments.steps is not None and arguments.minutes is not None:
        raise ValueError("--steps and --minutes exclude each other; give one of them")
    for name in ("steps", "envs", "film_every", "evaluate_every", "evaluate_episodes"):
        if getattr(arguments, name) is not None:
            whole(f"--{name.replace('_', '-')}", getattr(arguments, name), least=1)
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


def make_env(arguments: Train, preset: Preset | None, seed: int) -> VectorEnv:
    """Returns the environments to train on."""
    from rejeu.envs.vector import make_vector

    n_envs = arguments.envs or (preset.n_envs if preset else 1)
    backend = arguments.backend or (preset.backend if preset else "auto")
    restarts = arguments.restart_workers
    return make_vector(arguments.env, n_envs, backend, seed, restart_workers=restarts)  # type: ignore[arg-type]


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


def plan(arguments: Train, preset: Preset | None, algorithm: str, env: VectorEnv, seed: int) -> RunConfig:
    """Returns what will be done: what the arguments say, and where they are silent the preset or the defaults.

    Raises:
        TypeError: for an unknown hyper-parameter, with the nearest known one.
        ValueError: for a bad value.
    """
    from gymnasium import spaces

    from rejeu import AGENTS, config as configs, presets

    base = presets.default(env.env_id, algorithm) if preset is None else preset
    given = settings.apply(chain.from_iterable(arguments.assignments), base.hyperparameters)
    nested = isinstance(env.observation_space, spaces.Dict | spaces.Tuple)
    return RunConfig(
        env=env.env_id,
        algorithm=algorithm,
        preset=preset is not None,
        hyperparameters=configs.to_json(configs.build(AGENTS[algorithm].algorithm.Config, given)),
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


def make_agent(config: RunConfig, env: VectorEnv) -> Agent:
    """Returns the agent that a configuration describes."""
    from rejeu import AGENTS

    return AGENTS[config.algorithm](
        config.policy, env, seed=config.seed, success_threshold=config.success_threshold, **config.hyperparameters
    )


def make_evaluation_env(config: RunConfig) -> VectorEnv:
    """Returns up to 16 environments like those of training, seeded apart from them."""
    import numpy as np

    from rejeu.envs.vector import make_vector

    seed = int(np.random.SeedSequence([config.seed, 1]).generate_state(1)[0])
    backend = "envpool" if config.backend == "envpool" else "gymnasium"
    return make_vector(config.env, min(config.evaluate_episodes, 16), backend, seed)  # type: ignore[arg-type]


def train(
    agent: Agent, config: RunConfig, evaluation_env: VectorEnv, folder: RunFolder, limits: Limits, anew: bool = True
) -> Evaluate:
    """Trains, evaluates and saves; whatever ends it, the tables hold all that happened. Returns the evaluations.

    Args:
        agent: new, or taken up from a checkpoint.
        config: of the run.
        evaluation_env: to evaluate in.
        folder: where everything goes.
        limits: what ends it.
        anew: whether it begins, rather than goes on.
    """
    from rejeu import errors
    from rejeu.callbacks import Checkpoint, Evaluate, Film
    from rejeu.failed_writes import RetryingSink
    from rejeu.logging import CsvFile

    agent.report_folder = folder.path
    up_to = None if anew else agent.num_timesteps
    metrics = CsvFile(folder.metrics, up_to)
    table = RetryingSink(CsvFile(folder.evaluations, up_to), agent.failed_writes)
    evaluate = Evaluate(
        evaluation_env, config.evaluate_every, config.evaluate_episodes, folder.best, report=reporter(agent, table)
    )
    films = [] if config.film_every is None else [Film(folder.films, config.film_every, max_steps=VIDEO_STEPS)]
    checkpoints = []
    if config.checkpoint_minutes is not None:
        checkpoints.append(Checkpoint(folder.checkpoints, minutes=config.checkpoint_minutes))
    try:
        agent.learn(
            limits.steps,
            [evaluate, *films, *checkpoints],
            log_interval=4 * config.n_envs,
            reset_num_timesteps=anew,
            progress_bar=True,
            minutes=limits.minutes,
            sinks=[metrics],
        )
        save(agent, folder.agent)
        evaluated_last = bool(evaluate.results) and evaluate.results[-1].step == agent.num_timesteps
        if not agent.interrupted and not evaluated_last:
            evaluate.run(agent, agent.num_timesteps)
        if not evaluate.results:
            save(agent, folder.best)
    except (errors.BadEnvironmentError, errors.NonFiniteError, errors.WorkerError):
        save(agent, folder.agent)
        raise
    finally:
        agent.failed_writes.attempt(f"table {folder.episodes}", lambda: agent.history.write_csv(folder.episodes))
    return evaluate


def save(agent: Agent, path: Path) -> None:
    """Saves a model, or warns and tries again at the end of the command."""
    agent.failed_writes.attempt(f"model {path}", agent.snapshot(path))


def reporter(agent: Agent, table: Sink) -> Callable[[Evaluated, bool], None]:
    """Returns what prints an evaluation and adds it to a table."""

    def report(result: Evaluated, is_best: bool) -> None:
        evaluation = result.evaluation
        table.write(
            result.step,
            {
                "seconds": agent.seconds["total"],
                "success_rate": evaluation.success_rate,
                "mean_return": evaluation.mean_return,
                "std_return": evaluation.std_return,
                "mean_length": evaluation.mean_length,
                "episodes": len(evaluation.returns),
                "best": int(is_best),
            },
        )
        success = "" if math.isnan(evaluation.success_rate) else f"success {evaluation.success_rate:6.1%}  "
        say(f"step {result.step:>9,}  {success}return {evaluation.mean_return:,.2f}{'  (best)' if is_best else ''}")

    return report


def picture(agent: Agent, evaluate: Evaluate, config: RunConfig, folder: RunFolder) -> None:
    """Draws the curve and, unless Ctrl-C ended training, films the best model; says so where either is impossible."""
    import gymnasium

    from rejeu import load, plots
    from rejeu.video import record_video

    try:
        plots.learning_curve(
            agent.history, folder.curve, evaluations=evaluate.results, title=f"{config.env}, {config.algorithm}"
        )
    except (ImportError, OSError) as error:
        say(f"no curve: {' '.join(str(error).split())}")
    if agent.interrupted:
        say(f"no video of a run that was stopped; rejeu record {folder.path} makes one")
        return
    try:
        record_video(load(folder.best), folder.video, config.env, VIDEO_EPISODES, VIDEO_STEPS, config.seed)
    except (ImportError, ValueError, OSError, gymnasium.error.Error) as error:
        say(f"no video: {' '.join(str(error).split())}")


def header(config: RunConfig, backend: str, folder: RunFolder) -> str:
    """Returns what a run says of itself before it begins; ``backend`` says what steps the environments, and why."""
    what = "preset" if config.preset else "default hyper-parameters"
    span = f"{config.minutes:g} minutes" if config.steps is None else f"{config.steps:,} steps"
    every = f"evaluated on {config.evaluate_episodes} episodes every {config.evaluate_every:,} steps"
    return "\n".join(
        [
            f"environment   {config.env}, {config.n_envs} at once",
            f"backend       {backend}",
            f"algorithm     {config.algorithm}, {what}, seed {config.seed}",
            f"training      {span}, {every}",
            f"run folder    {folder.path}",
        ]
    )


def summary(agent: Agent, evaluate: Evaluate, folder: RunFolder, seconds: float, compile_seconds: float) -> str:
    """Returns what a run says at its end."""
    lines = [""]
    if agent.interrupted:
        how = f"; rejeu resume {folder.path} goes on" if folder.checkpoints.is_dir() else ""
        name = "Ctrl-C" if agent.interrupted_by == signal.SIGINT else "SIGTERM"
        saved = "; everything is saved" if agent.failed_writes.complete else ""
        lines.append(f"stopped by {name}{saved}{how}")
    if agent.ep_info_buffer:
        lines.append(f"training      last {len(agent.ep_info_buffer)} episodes: {training(agent)}")
    if evaluate.best is not None:
        lines.append(f"best model    step {evaluate.best.step:,}: {evaluate.best.evaluation}")
    files = ", ".join(sorted(path.name for path in folder.path.iterdir()))
    return "\n".join(
        [
            *lines,
            f"files         {folder.path}: {files}",
            f"time          {seconds:.1f} s in all, {compile_seconds:.1f} s of them compiling; "
            f"{agent.num_timesteps:,} steps at {agent.steps_per_second:,.0f} steps/s",
            f"try it        rejeu evaluate {folder.path} --backend gymnasium",
        ]
    )


def training(agent: Agent) -> str:
    """Returns what the last episodes of training came to: return, length and, where it is known, success."""
    import numpy as np

    returns, lengths = ([episode[key] for episode in agent.ep_info_buffer] for key in ("r", "l"))
    text = f"return {np.mean(returns):.2f} ± {np.std(returns):.2f}, length {np.mean(lengths):.1f}"
    return f"success {np.mean(agent.ep_success_buffer):.1%}, {text}" if agent.ep_success_buffer else text
