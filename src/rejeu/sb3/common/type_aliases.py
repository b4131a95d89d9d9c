"""Types of what buffers and training return."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from rejeu.callbacks.base import Callback
from rejeu.core.types import Info, Observation
from rejeu.sb3.common.vec_env.base_vec_env import VecEnv

GymEnv = gym.Env | VecEnv
GymObs = Any
GymResetReturn = tuple[Observation, Info]
GymStepReturn = tuple[Observation, float, bool, bool, Info]
AtariResetReturn = tuple[np.ndarray, Info]
AtariStepReturn = tuple[np.ndarray, float, bool, bool, Info]
TensorDict = dict[str, np.ndarray]
TensorIndex = Any
MaybeCallback = Callback | list[Callback] | None
PolicyPredictor = Any
PyTorchObs = Any
Schedule = Callable[[float], float]


class RolloutBufferSamples(NamedTuple):
    """A minibatch of a rollout; every array has a leading batch axis."""

    observations: Observation
    actions: np.ndarray
    old_values: np.ndarray
    old_log_prob: np.ndarray
    advantages: np.ndarray
    returns: np.ndarray


class ReplayBufferSamples(NamedTuple):
    """A batch of transitions; every array has a leading batch axis."""

    observations: Observation
    actions: np.ndarray
    next_observations: Observation
    dones: np.ndarray
    """``(batch, 1)``, 1 where the MDP terminated."""
    rewards: np.ndarray
    """``(batch, 1)``."""
    discounts: np.ndarray | None = None
    """``(batch, 1)``, of n-step returns."""


class DictRolloutBufferSamples(RolloutBufferSamples):
    """A minibatch with Dict observations."""


class DictReplayBufferSamples(ReplayBufferSamples):
    """A batch with Dict observations."""


class RolloutReturn(NamedTuple):
    """The result of one collection of experience."""

    episode_timesteps: int
    n_episodes: int
    continue_training: bool


class TrainFrequencyUnit(Enum):
    """The unit of ``train_freq``."""

    STEP = "step"
    EPISODE = "episode"


class TrainFreq(NamedTuple):
    """After how many steps or episodes an update follows."""

    frequency: int
    unit: TrainFrequencyUnit
