"""Callbacks: evaluation, checkpoints, videos, a progress bar and early stopping.

A callback is any callable. ``agent.learn`` calls it after every step of the environments as ``callback(agent, progress)``;
only ``False`` stops training. A :class:`TrainingCallback` is also called when training starts and ends. All frequencies
are in environment steps, over all environments.
"""

from rejeu.callbacks.base import Callback, TrainingCallback
from rejeu.callbacks.checkpoint import Checkpoint
from rejeu.callbacks.evaluate import Evaluate, Evaluated
from rejeu.callbacks.progress_bar import ProgressBar
from rejeu.callbacks.record_video import Film, RecordVideo
from rejeu.callbacks.stopping import print_records, stop_on_return, stop_on_success

__all__ = [
    "Callback",
    "Checkpoint",
    "Evaluate",
    "Evaluated",
    "Film",
    "ProgressBar",
    "RecordVideo",
    "TrainingCallback",
    "print_records",
    "stop_on_return",
    "stop_on_success",
]
