"""Callbacks: evaluation, checkpoints, videos, a progress bar and early stopping.

A callback is any callable. ``agent.learn`` calls it after every step of the environments as ``callback(agent, progress)``;
only ``False`` stops training. A :class:`TrainingCallback` is also called when training starts and ends. All frequencies
are in environment steps, over all environments.
"""

from rejeu.callbacks.base import Callback, TrainingCallback, crossed, step_before
from rejeu.callbacks.checkpoint import Checkpoint
from rejeu.callbacks.evaluate import EVALUATED, EVALUATION, Evaluate, Evaluated, better, merit
from rejeu.callbacks.progress_bar import (
    LINE_SECONDS,
    RATE_SECONDS,
    REFRESH_SECONDS,
    ProgressBar,
    duration,
    status,
    time_spent,
)
from rejeu.callbacks.record_video import Film, RecordVideo
from rejeu.callbacks.stopping import print_records, stop_on_return, stop_on_success

__all__ = [
    "EVALUATED",
    "EVALUATION",
    "LINE_SECONDS",
    "RATE_SECONDS",
    "REFRESH_SECONDS",
    "Callback",
    "Checkpoint",
    "Evaluate",
    "Evaluated",
    "Film",
    "ProgressBar",
    "RecordVideo",
    "TrainingCallback",
    "better",
    "crossed",
    "duration",
    "merit",
    "print_records",
    "status",
    "step_before",
    "stop_on_return",
    "stop_on_success",
    "time_spent",
]
