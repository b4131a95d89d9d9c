"""Soft actor-critic (SAC): :mod:`continuous` for Box, :mod:`discrete` for Discrete, :mod:`mixed` for Dict and Tuple."""

from gymnasium import spaces

from rejeu.algorithms.sac import continuous, discrete, mixed
from rejeu.algorithms.sac.continuous import Config
from rejeu.algorithms.soft import State
from rejeu.core.algorithm import Algorithm

__all__ = ["Config", "State", "make"]


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns SAC for these spaces.

    Raises:
        ValueError: if the action space is neither a finite Box, nor Discrete, nor a Dict or Tuple.
        TypeError: if the observation space holds something that is not an array.
    """
    if isinstance(action_space, spaces.Dict | spaces.Tuple):
        return mixed.make(config, observation_space, action_space)
    module = discrete if isinstance(action_space, spaces.Discrete) else continuous
    return module.make(config, observation_space, action_space)
