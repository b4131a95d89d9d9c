"""A session of training in a run folder, of ``rejeu train`` or ``rejeu resume``, and the files that it leaves."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rejeu.agents import Agent, load
from rejeu.agents.training import run_name, tracker_id
from rejeu.callbacks import Checkpoint, Evaluate, RecordVideo
from rejeu.callbacks.base import restore
from rejeu.checkpoints.run_folder import RunFolder, create
from rejeu.core import errors, xla
from rejeu.core.errors import one_line
from rejeu.core.interrupt import Interrupt, leaving
from rejeu.core.types import JsonObject
from rejeu.envs.make import VectorEnv
from rejeu.lab.runs import config as runs
from rejeu.lab.runs.config import DecidedRun, RunConfig
from rejeu.lab.runs.environment import Environment
from rejeu.lab.runs.output import Stopwatch, as_dict, echo, noted_in, reporter, summary
from rejeu.lab.runs.requests import Requests, ask
from rejeu.logs import plots, video
from rejeu.logs.formatting import counted, quoted
from rejeu.logs.history import EpisodeTable
from rejeu.logs.logging import CsvFile, GuardedSink, Sink, check_logs, guarded, open_log, require
from rejeu.logs.video import ffmpeg
from rejeu.training.run import Progress

VIDEO_EPISODES = 3
VIDEO_STEPS = 600
"""Most steps of a video: a poor policy's episodes are long, and highway-env renders some 70 frames a second."""


Report = Callable[[Path, Path], object]
"""``report(folder, path)`` writes the page about the run in a folder."""


def installed_logs(arguments: RunConfig) -> tuple[str, ...]:
    """Returns the logs of ``--log``.

    Raises:
        ValueError: for an unknown one.
        MissingExtra: if what they or ``--video-every`` need is not installed, before anything is trained.
    """
    logs = check_logs("--log", arguments.log)
    require(logs)
    if arguments.video_every is not None:
        ffmpeg()
    return logs


class TrainingLimits(NamedTuple):
    """Limits of training."""

    steps: int | None = None
    """Environment steps to take; with ``minutes`` None too, the goal that the run has already."""
    minutes: float | None = None
    """Minutes to train for."""
    pause_steps: int | None = None
    """Pause after this many further environment steps, without changing the goal."""
    pause_minutes: float | None = None
    """Pause after this many further minutes, without changing the goal."""


class Learning(NamedTuple):
    """Callbacks and outputs of ``learn`` in a session."""

    evaluate: Evaluate
    callbacks: list[Any]
    """All of them, with ``evaluate``."""
    sinks: list[GuardedSink]
    """The outputs of the rows of statistics, of episodes and of the video."""
    session: Session
    """The session with the full path of its folder: an environment may change the current folder."""

    def close(self) -> None:
        """Closes the outputs."""
        for output in self.sinks:
            output.close()


class Session(NamedTuple):
    """One ``rejeu train`` or ``rejeu resume`` of a run."""

    agent: Agent
    config: DecidedRun
    folder: RunFolder
    environment: Environment
    evaluation_env: VectorEnv
    limits: TrainingLimits
    is_new: bool
    """Whether the run begins here, rather than being resumed."""
    report: Report | None = None
    """Writes ``report.html`` at the end; None for neither page nor ``curve.png``."""
    has_video: bool = True
    """Whether a video is recorded at the end."""
    backend: str = ""
    """Description of the backend."""
    more: tuple[Any, ...] = ()
    """Further callbacks."""
    label: str = ""
    """Beginning of the lines about its evaluations, where several runs are trained together."""

    def in_new_folder(self, out: Path | None) -> Session:
        """Returns the session in a folder that is made: ``out``, or one under ``runs``."""
        return self.in_folder(create(out, self.config.env, self.config.algorithm, self.config.seed))

    def in_folder(self, folder: RunFolder, label: str = "") -> Session:
        """Returns the session in an empty folder, which is locked, and to which its configuration is written."""
        self.agent.checkpoint_folder(folder.checkpoints).lock()  # before others see a run
        runs.write(folder.config, self.config)
        return self._replace(folder=folder, label=label)

    @property
    def is_over(self) -> bool:
        """Whether there is nothing left to train, so that only files are written."""
        return not self.is_new and self.limits == TrainingLimits() and has_reached_goal(self.agent)

    def run(self, stop: Interrupt, stopwatch: Stopwatch) -> tuple[int, JsonObject]:
        """Trains, evaluates, plots and records a video; prints a summary, and returns the exit status and the result.

        The status is 0, 2 if something could not be written, 130 after Ctrl-C and 143 after SIGTERM. Until the models are
        saved, signals are requests to stop after the current step; afterwards they end the process at once.
        """
        with self.training(stop) as learning:
            if self.is_over:
                restore(self.agent, learning.callbacks)
            else:
                self.agent.learn(
                    self.limits.steps,
                    learning.callbacks,
                    log_interval=self.log_interval,
                    reset_num_timesteps=self.is_new,
                    progress_bar=True,
                    minutes=self.limits.minutes,
                    sinks=learning.sinks,
                )
        return self.finish(learning, stop, stopwatch)

    @property
    def log_interval(self) -> int:
        """Episodes between two rows of statistics."""
        return 4 * self.config.n_envs

    def finish(self, learning: Learning, stop: Interrupt, stopwatch: Stopwatch) -> tuple[int, JsonObject]:
        """Evaluates, plots and records a video after training; prints a summary, and returns what :meth:`run` does."""
        agent, environment, evaluate, session = self.agent, self.environment, learning.evaluate, learning.session
        is_complete = not stop.requested and has_reached_goal(agent)
        try:
            if is_complete:
                with leaving(f"interrupted after training; the models are saved in {self.folder.path}"):
                    evaluate_now(evaluate, agent)
                    session.plot_curve(evaluate)
                    if self.has_video:
                        session.record_video(learning)
            else:
                if stop.signal is None:
                    ask(session.folder.paused)
                session.plot_curve(evaluate)
                again = f"rejeu record {quoted(self.folder.path)}{environment.run.again()}"
                echo(f"no video of a run that was stopped; {again} makes one")
        except Exception:
            session.write_report()
            raise
        finally:
            learning.close()
        agent.failed_writes.retry()
        session.write_report()
        result = as_dict(agent, session.folder, evaluate, stop.signal, is_complete, stopwatch) | {
            "run": self.folder.path
        }
        echo(summary(result, agent, session.folder, environment, evaluate))
        if failed := agent.failed_writes.summary():
            print(f"warning: {failed}", file=sys.stderr)
        if stop.signal is not None:
            return 128 + stop.signal, result
        return (0 if agent.failed_writes.complete else 2), result

    def outputs(self) -> list[GuardedSink]:
        """Returns the outputs of the rows of statistics, and the table of episodes."""
        agent, up_to = self.agent, None if self.is_new else self.agent.num_timesteps
        sinks: list[Sink] = [
            open_log(name, self.folder.path, run_name(agent), tracker_id(agent), self.folder.metrics.stem, up_to)
            for name in dict.fromkeys(("csv", *self.config.log))
        ]
        sinks.append(EpisodeTable(lambda: agent.history, self.folder.episodes))
        return [guarded(sink, agent.failed_writes, closes=True) for sink in sinks]

    @contextmanager
    def training(self, stop: Interrupt) -> Iterator[Learning]:
        """Context in which the agent learns, with what ``learn`` is to be given.

        At its end models and tables are written, and then the folder is unlocked.
        """
        agent, folder = self.agent, RunFolder(self.folder.path.absolute())
        session = self._replace(folder=folder)
        outputs = session.outputs()
        agent.report_folder = folder.path
        evaluate, callbacks = session.callbacks(stop)
        learning = Learning(evaluate, callbacks, outputs, session)
        try:
            lock = closing(agent.checkpoint_folder(folder.checkpoints))
            with lock, noted_in(folder.warnings), saved_at_exit(agent, folder, evaluate):
                yield learning
        except BaseException as error:
            if isinstance(error, Exception):
                session.write_report()
            learning.close()
            raise

    def callbacks(self, stop: Interrupt) -> tuple[Evaluate, list[Any]]:
        """Returns the callback that evaluates, and all callbacks of the run."""
        agent, config, folder = self.agent, self.config, self.folder
        table = CsvFile(folder.evaluations, None if self.is_new else agent.num_timesteps)
        report = reporter(agent, GuardedSink(table, agent.failed_writes), folder, self.label)
        every, episodes = config.evaluate_every, config.evaluate_episodes
        evaluate = Evaluate(self.evaluation_env, every, episodes, folder.best, report=report)
        is_pause_due = pause(agent, self.limits)

        def save(agent: Agent, turn: Progress) -> None:
            if has_reached_goal(agent):  # before the last evaluation, which may take longer than training
                save_model(agent, folder.agent)
                echo(f"{self.label}evaluating the final policy on {counted(episodes, 'episode')}; Ctrl-C ends it")

        def finish(agent: Agent, turn: Progress) -> bool:
            if not stop.requested and has_reached_goal(agent):
                evaluate_now(evaluate, agent)  # here, and not after learn, so that the last checkpoint contains it
            return not (stop.requested or is_pause_due(turn))

        callbacks: list[Any] = [Requests(folder, stop), save, evaluate, finish, *self.more]
        if config.video_every is not None:
            render = self.environment.rendering
            callbacks.append(RecordVideo(folder.videos, config.video_every, env=render, max_steps=VIDEO_STEPS))
        if config.checkpoint_minutes:
            minutes, keep = config.checkpoint_minutes, config.keep_checkpoints
            callbacks.append(Checkpoint(folder.checkpoints, minutes=minutes, keep=keep))
        return evaluate, callbacks

    def plot_curve(self, evaluate: Evaluate) -> None:
        """Plots the learning curve or prints why not, unless the run is to have no report."""
        title = f"{self.environment.env_id}, {self.agent.name}"
        if self.report is not None:
            with optional("curve"):
                plots.learning_curve(self.agent.history, self.folder.curve, evaluations=evaluate.results, title=title)

    def record_video(self, learning: Learning) -> None:
        """Records a video of the best model and adds it to the outputs, or prints why not."""
        agent, folder, make = self.agent, self.folder, self.environment.rendering
        with optional("video", (Exception,)):  # the environment can raise anything
            video.record_video(load(folder.best), folder.video, make, VIDEO_EPISODES, VIDEO_STEPS, self.config.seed)
            for output in learning.sinks:
                output.write_video(agent.num_timesteps, folder.video)

    def write_report(self) -> None:
        """Writes the page about the run or prints why not, unless the run is to have none."""
        if self.report is not None:
            with optional("report"):
                self.report(self.folder.path, self.folder.report)


@contextmanager
def optional(output: str, expected: tuple[type[Exception], ...] = (ImportError, OSError)) -> Iterator[None]:
    """Context whose failure to write something is one line; ``expected`` are the errors of such a failure."""
    try:
        yield
    except expected as error:
        echo(f"no {output}: {one_line(error)}")


def make_evaluation_env(config: DecidedRun, environment: Environment) -> VectorEnv:
    """Returns up to 16 environments like those of training, with other seeds."""
    seed = int(np.random.SeedSequence([config.seed, 1]).generate_state(1)[0])
    backend = config.backend if config.backend in ("envpool", "jax") else "gymnasium"
    return environment.vector(min(config.evaluate_episodes, 16), backend, seed)


def evaluate_now(evaluate: Evaluate, agent: Agent) -> None:
    """Evaluates an agent, unless that was done at this step."""
    if not evaluate.results or evaluate.results[-1].step != agent.num_timesteps:
        evaluate.run(agent, agent.num_timesteps)


def has_reached_goal(agent: Agent) -> bool:
    """Returns whether the current or last ``learn`` reached its limit."""
    return agent.call.training_call is None or agent.call.training_call.is_over(agent.run)


def pause(agent: Agent, limits: TrainingLimits) -> Callable[[Progress], bool]:
    """Returns a function that returns whether a pause is due after a turn of the loop."""
    last_step = math.inf if limits.pause_steps is None else agent.num_timesteps + limits.pause_steps
    until = math.inf if limits.pause_minutes is None else xla.clock() + 60 * limits.pause_minutes
    return lambda turn: agent.num_timesteps >= last_step or xla.clock() >= until


@contextmanager
def saved_at_exit(agent: Agent, folder: RunFolder, evaluate: Evaluate) -> Iterator[None]:
    """Context at whose end models and tables are written, also after an error of the environment or of the numbers."""
    try:
        yield
        save_model(agent, folder.agent)
        if not evaluate.results:
            save_model(agent, folder.best)
    except (errors.BadEnvironmentError, errors.NonFiniteError, errors.WorkerError):
        save_model(agent, folder.agent)  # raises the same error where the weights are not finite
        raise
    finally:
        write = partial(agent.history.write_csv, folder.episodes)
        agent.failed_writes.attempt(f"rows of {folder.episodes}", write)


def save_model(agent: Agent, path: Path) -> None:
    """Saves a model, or warns and tries again at the end of the command."""
    agent.failed_writes.attempt(f"model {path}", agent.snapshot(path), is_model=True)
