"""Deep deterministic policy gradient (DDPG): :mod:`continuous` for Box actions, :mod:`discrete` for Discrete actions."""

from gymnasium import spaces

from rejeu.algorithms.ddpg import continuous, discrete
from rejeu.algorithms.ddpg.continuous import (
    HIDDEN_LAYERS,
    Config,
    State,
    action_value,
    actor_loss,
    critic_loss,
    policy,
    td_target,
)
from rejeu.core import Algorithm

__all__ = [
    "HIDDEN_LAYERS",
    "Config",
    "State",
    "action_value",
    "actor_loss",
    "critic_loss",
    "make",
    "policy",
    "td_target",
]


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns DDPG for these spaces.

    Raises:
        ValueError: if the action space is neither a finite Box nor Discrete.
        TypeError: if the observation space holds something that is not an array.
    """
    module = discrete if isinstance(action_space, spaces.Discrete) else continuous
    return module.make(config, observation_space, action_space)
