"""Callbacks: evaluation, checkpoints, videos, a progress bar and early stopping.

A callback is any callable. ``agent.learn`` calls it after every step of the environments as ``callback(agent, progress)``;
only ``False`` stops training. A :class:`TrainingCallback` is also called when training starts and ends. All frequencies
are in environment steps, over all environments.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from rejeu.callbacks.base import Callback, TrainingCallback
from rejeu.callbacks.checkpoint import Checkpoint
from rejeu.callbacks.evaluate import Evaluate, Evaluated
from rejeu.callbacks.progress_bar import ProgressBar
from rejeu.callbacks.record_video import RecordVideo
from rejeu.core.validation import whole
from rejeu.training.run import Episode, Progress

__all__ = [
    "Callback",
    "Checkpoint",
    "Evaluate",
    "Evaluated",
    "ProgressBar",
    "RecordVideo",
    "TrainingCallback",
    "print_records",
    "stop_on_return",
    "stop_on_success",
]


def stop_on_return(threshold: float, episodes: int = 100) -> Callback:
    """Returns a callback that stops once the mean return of the last ``episodes`` episodes is at least ``threshold``.

    >>> import rejeu
    >>> agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", learning_starts=10_000, seed=0)
    >>> agent.learn(10_000, stop_on_return(-5_000, episodes=2)).num_timesteps
    400
    """
    return _stop_on_mean(threshold, episodes, lambda episode: episode.episode_return)


def stop_on_success(rate: float, episodes: int = 100) -> Callback:
    """Returns a callback that stops once at least ``rate`` (in [0, 1]) of the last ``episodes`` episodes succeeded.

    It never stops if the environment does not report success.

    Raises:
        ValueError: if ``rate`` is not in [0, 1].
    """
    if not 0 <= rate <= 1:
        raise ValueError(f"rate={rate} must be a share in [0, 1]; for 90 % write 0.9")
    return _stop_on_mean(rate, episodes, lambda episode: episode.success)


def _stop_on_mean(least: float, episodes: int, value: Callable[[Episode], float]) -> Callback:
    whole("episodes", episodes, least=1)

    def stop(agent: Any, progress: Progress) -> bool:
        last = agent.history.last(episodes) if progress.episodes else []
        values = [number for number in map(value, last) if not math.isnan(number)]  # success may be unknown of some
        return not (len(last) == episodes and values and np.mean(values) >= least)

    return stop


def print_records(agent: Any, progress: Progress) -> None:
    """Prints a line for every record, an episode with a higher return than all before it in the agent's history.

    It is a callback for ``learn``. ``agent.history.records()`` returns the same episodes.

    >>> import rejeu
    >>> agent = rejeu.DQN("MlpPolicy", "MountainCar-v0", learning_starts=10_000, seed=0)
    >>> agent = agent.learn(400, print_records)
    ↗ return -200.00 at step 200
    """
    if not progress.episodes:
        return
    for record in agent.history.records():
        if record.step == progress.step:
            print(f"↗ return {record.episode_return:,.2f} at step {record.step:,}", flush=True)
