"""What ``rejeu train`` and ``rejeu resume`` leave in a run folder when training ends: models, tables, curve, video, page."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import gymnasium

from rejeu import errors
from rejeu.agents import Agent, load
from rejeu.callbacks import Evaluate
from rejeu.cli.environment import Environment
from rejeu.cli.output import echo
from rejeu.reporting import plots, report, video
from rejeu.reporting.logging import RetryingSink
from rejeu.runs.folder import RunFolder, write_arrivals as write_order

VIDEO_EPISODES = 3
VIDEO_STEPS = 600
"""Most steps of a video: a poor policy's episodes are long, and highway-env renders some 70 frames a second."""


@contextmanager
def saved_at_exit(agent: Agent, folder: RunFolder, evaluate: Evaluate) -> Iterator[None]:
    """Context at whose end models and tables are written, also after an error of the environment or of the numbers."""
    try:
        yield
        save(agent, folder.agent)
        if not evaluate.results:
            save(agent, folder.best)
    except (errors.BadEnvironmentError, errors.NonFiniteError, errors.WorkerError):
        save(agent, folder.agent)
        raise
    finally:
        write_arrivals(agent, folder)
        write = partial(agent.history.write_csv, folder.episodes)
        agent.failed_writes.attempt(f"table {folder.episodes}", write)


def write_arrivals(agent: Agent, folder: RunFolder) -> None:
    """Writes the order in which the results of environments were taken, if they did not wait for each other."""
    if agent.env is not None and (arrivals := agent.env.arrivals) is not None:
        write = partial(write_order, folder, arrivals)
        agent.failed_writes.attempt(f"order of arrival {folder.arrivals}", write)


def save(agent: Agent, path: Path) -> None:
    """Saves a model, or warns and tries again at the end of the command."""
    agent.failed_writes.attempt(f"model {path}", agent.snapshot(path))


def plot_curve(agent: Agent, folder: RunFolder, environment: Environment, evaluate: Evaluate) -> None:
    """Plots the learning curve, or prints why not."""
    title = f"{environment.env_id}, {agent.name}"
    try:
        plots.learning_curve(agent.history, folder.curve, evaluations=evaluate.results, title=title)
    except (ImportError, OSError) as error:
        echo(f"no curve: {' '.join(str(error).split())}")


def record_video(
    agent: Agent, folder: RunFolder, environment: Environment, seed: int, outputs: Iterable[RetryingSink]
) -> None:
    """Records a video of the best model and adds it to the outputs, or prints why not."""
    render = environment.rendering
    try:
        video.record_video(load(folder.best), folder.video, render, VIDEO_EPISODES, VIDEO_STEPS, seed)
    except (ImportError, ValueError, OSError, gymnasium.error.Error) as error:
        echo(f"no video: {' '.join(str(error).split())}")
        return
    for output in outputs:
        output.write_video(agent.num_timesteps, folder.video)


def write_report(folder: RunFolder) -> None:
    """Writes the page about the run, or prints why not."""
    try:
        report.write_report(folder.path, folder.report)
    except (ImportError, OSError) as error:
        echo(f"no report: {' '.join(str(error).split())}")
