"""Deep deterministic policy gradient (DDPG): :mod:`continuous` for Box actions, :mod:`discrete` for Discrete actions."""

from gymnasium import spaces

from rejeu.algorithms.ddpg import continuous, discrete
from rejeu.algorithms.ddpg.continuous import Config, State
from rejeu.core.algorithm import Algorithm

__all__ = ["Config", "State", "make"]


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns DDPG for these spaces.

    Raises:
        ValueError: if the action space is neither a finite Box nor Discrete.
        TypeError: if the observation space holds something that is not an array.
    """
    module = discrete if isinstance(action_space, spaces.Discrete) else continuous
    return module.make(config, observation_space, action_space)
