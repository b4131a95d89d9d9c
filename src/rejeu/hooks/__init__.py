"""Callbacks as objects with hooks, as Stable-Baselines3's are; ``learn`` takes them beside rejeu's own functions.

A heir of :class:`BaseCallback` defines ``_on_step``, which returns whether to go on, and any of ``_on_training_start``,
``_on_rollout_start``, ``_on_rollout_end`` and ``_on_training_end``. A *call* is one step of all environments together, so
frequencies in calls (``eval_freq``, ``save_freq``) mean ``n_envs`` times as many environment steps. New code may find
:mod:`rejeu.callbacks` simpler, whose frequencies are in environment steps.

A rollout is what comes between two updates: ``n_steps`` calls with PPO and A2C, ``train_freq`` with the others. Unlike
there, the update that a rollout ends in has been started when ``_on_step`` and ``_on_rollout_end`` of its last step are
called.
"""

from rejeu.hooks.base import BaseCallback, CallbackList, ConvertCallback, EventCallback, hooked
from rejeu.hooks.calling import infos_of
from rejeu.hooks.evaluation import EvalCallback, StopTrainingOnNoModelImprovement, StopTrainingOnRewardThreshold
from rejeu.hooks.ready_made import (
    CheckpointCallback,
    EveryNTimesteps,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
)

__all__ = [
    "BaseCallback",
    "CallbackList",
    "CheckpointCallback",
    "ConvertCallback",
    "EvalCallback",
    "EventCallback",
    "EveryNTimesteps",
    "ProgressBarCallback",
    "StopTrainingOnMaxEpisodes",
    "StopTrainingOnNoModelImprovement",
    "StopTrainingOnRewardThreshold",
    "hooked",
    "infos_of",
]
