"""What ``rejeu train`` and ``rejeu resume`` have in common: training in a run folder, and what is left there."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rejeu.cli.environment import Environment
from rejeu.cli.run_folder import RunConfig, RunFolder
from rejeu.cli.telling import reporter, say, summary
from rejeu.interrupt import Interrupt, leaving

if TYPE_CHECKING:
    from rejeu.agents import Agent
    from rejeu.callbacks import Evaluate
    from rejeu.envs.make import VectorEnv
    from rejeu.loops.run import Progress

VIDEO_EPISODES = 3
VIDEO_STEPS = 600
"""Most steps filmed, for a poor policy's episodes are long and highway-env draws some 70 a second."""


class Limits(NamedTuple):
    """What ends training."""

    steps: int | None = None
    """Environment steps to take; with ``minutes`` None too, the goal that the run has already."""
    minutes: float | None = None
    """Minutes to train for."""
    pause_steps: int | None = None
    """Pause after so many environment steps from here, with the goal left as it is."""
    pause_minutes: float | None = None
    """Pause after so many minutes from here, likewise."""


class Session(NamedTuple):
    """One stretch of training a run."""

    agent: Agent
    config: RunConfig
    folder: RunFolder
    environment: Environment
    evaluation_env: VectorEnv
    limits: Limits
    is_new: bool
    """Whether the run begins here, rather than being resumed."""


class Watch:
    """Measures what a command takes, from when it is made."""

    def __init__(self) -> None:
        from rejeu import xla

        self._began, self._compiled = time.perf_counter(), xla.seconds()

    def seconds(self) -> tuple[float, float]:
        """Returns wall time, and how much of it went into compiling."""
        from rejeu import xla

        return time.perf_counter() - self._began, xla.seconds() - self._compiled


def make_agent(config: RunConfig, env: VectorEnv) -> Agent:
    """Returns the agent that a configuration describes."""
    from rejeu import AGENTS

    return AGENTS[config.algorithm](
        config.policy, env, seed=config.seed, success_threshold=config.success_threshold, **config.hyperparameters
    )


def make_evaluation_env(config: RunConfig, environment: Environment) -> VectorEnv:
    """Returns up to 16 environments like those of training, seeded apart from them."""
    import numpy as np

    seed = int(np.random.SeedSequence([config.seed, 1]).generate_state(1)[0])
    backend = "envpool" if config.backend == "envpool" else "gymnasium"
    return environment.vector(min(config.evaluate_episodes, 16), backend, seed)


def carry_out(session: Session, stop: Interrupt, watch: Watch) -> int:
    """Trains, evaluates, draws and films; says what came of it and returns the exit status.

    That is 0, 2 if something could not be written, 130 after Ctrl-C and 143 after SIGTERM.

    Until all that was learnt is saved, signals are requests to stop after the step under way. What comes afterwards is left at
    once: a further evaluation, the curve and the video.
    """
    agent, folder = session.agent, session.folder
    evaluate, is_complete = train(session, stop)
    written = agent.failed_writes.retry()
    if is_complete:
        with leaving(f"interrupted after training; the models are saved in {folder.path}"):
            evaluate_at(evaluate, agent)
            draw(session, evaluate)
            film(session)
    else:
        draw(session, evaluate)
        say(f"no video of a run that was stopped; rejeu record {folder.path}{session.environment.options()} makes one")
    say(summary(session, evaluate, stop.signal, is_complete, *watch.seconds()))
    if failed := agent.failed_writes.summary():
        print(f"warning: {failed}", file=sys.stderr)
    if stop.signal is not None:
        return 128 + stop.signal
    return 0 if written else 2


def train(session: Session, stop: Interrupt) -> tuple[Evaluate, bool]:
    """Trains and saves; whatever ends it, the tables hold all that happened.

    Args:
        session: what is trained, how long and where it is saved.
        stop: says whether a signal asked to stop.

    Returns:
        The evaluations, and whether the goal was reached.
    """
    from rejeu import errors
    from rejeu.callbacks import Checkpoint, Evaluate, Film
    from rejeu.io.failed_writes import RetryingSink
    from rejeu.reporting.logging import CsvFile

    agent, config, folder, limits = session.agent, session.config, session.folder, session.limits
    agent.report_folder = folder.path
    up_to = None if session.is_new else agent.num_timesteps
    metrics = CsvFile(folder.metrics, up_to)
    table = RetryingSink(CsvFile(folder.evaluations, up_to), agent.failed_writes)
    every, episodes = config.evaluate_every, config.evaluate_episodes
    evaluate = Evaluate(session.evaluation_env, every, episodes, folder.best, report=reporter(agent, table))
    paused = pause(agent, limits)

    def finish(agent: Agent, turn: Progress) -> bool:
        if not stop.requested and has_reached_goal(agent):
            evaluate_at(evaluate, agent)  # here, and not after learn, so that the last checkpoint knows of it
        return not (stop.requested or paused(turn))

    callbacks: list[Any] = [evaluate, finish]
    if config.film_every is not None:
        drawing = session.environment.drawing
        callbacks.append(Film(folder.films, config.film_every, env=drawing, max_steps=VIDEO_STEPS))
    if config.checkpoint_minutes is not None:
        callbacks.append(Checkpoint(folder.checkpoints, minutes=config.checkpoint_minutes))
    try:
        agent.learn(
            limits.steps,
            callbacks,
            log_interval=4 * config.n_envs,
            reset_num_timesteps=session.is_new,
            progress_bar=True,
            minutes=limits.minutes,
            sinks=[metrics],
        )
        save(agent, folder.agent)
        if not evaluate.results:
            save(agent, folder.best)
    except (errors.BadEnvironmentError, errors.NonFiniteError, errors.WorkerError):
        save(agent, folder.agent)
        raise
    finally:
        agent.failed_writes.attempt(f"table {folder.episodes}", lambda: agent.history.write_csv(folder.episodes))
    return evaluate, not stop.requested and has_reached_goal(agent)


def save(agent: Agent, path: Path) -> None:
    """Saves a model, or warns and tries again at the end of the command."""
    agent.failed_writes.attempt(f"model {path}", agent.snapshot(path))


def evaluate_at(evaluate: Evaluate, agent: Agent) -> None:
    """Evaluates an agent where it stands, unless that was done."""
    if not evaluate.results or evaluate.results[-1].step != agent.num_timesteps:
        evaluate.run(agent, agent.num_timesteps)


def has_reached_goal(agent: Agent) -> bool:
    """Returns whether the ``learn`` that an agent is or was in went as far as it was to go."""
    return agent._call is None or agent._call.is_over(agent.run.step, agent.run.episode)


def pause(agent: Agent, limits: Limits) -> Callable[[Progress], bool]:
    """Returns what says whether a pause is due after a turn of the loop."""
    last_step = None if limits.pause_steps is None else agent.num_timesteps + limits.pause_steps
    until = None if limits.pause_minutes is None else time.monotonic() + 60 * limits.pause_minutes

    def is_due(turn: Progress) -> bool:
        by_steps = last_step is not None and agent.num_timesteps >= last_step
        return by_steps or (until is not None and time.monotonic() >= until)

    return is_due


def draw(session: Session, evaluate: Evaluate) -> None:
    """Draws the curve, or says why not."""
    from rejeu.reporting import plots

    title = f"{session.environment.env_id}, {session.config.algorithm}"
    try:
        plots.learning_curve(session.agent.history, session.folder.curve, evaluations=evaluate.results, title=title)
    except (ImportError, OSError) as error:
        say(f"no curve: {' '.join(str(error).split())}")


def film(session: Session) -> None:
    """Films the best model, or says why not."""
    import gymnasium

    from rejeu import load
    from rejeu.reporting.video import record_video

    folder = session.folder
    try:
        env = session.environment.drawing
        record_video(load(folder.best), folder.video, env, VIDEO_EPISODES, VIDEO_STEPS, session.config.seed)
    except (ImportError, ValueError, OSError, gymnasium.error.Error) as error:
        say(f"no video: {' '.join(str(error).split())}")
