"""Stable-Baselines3's module paths, leading to rejeu.

A script moves over by replacing ``stable_baselines3`` by ``rejeu.sb3`` in its imports. Nothing is defined here but names
and a few adaptations; what rejeu does not have cannot be imported. The algorithms of sb3-contrib (``QRDQN``, ``TQC``,
``CrossQ``, ``RecurrentPPO``, ``MaskablePPO``) stand beside the others.

>>> from rejeu.sb3 import SAC, HerReplayBuffer
>>> from rejeu.sb3.common.env_util import make_vec_env
"""

from rejeu.agents import A2C, DDPG, DQN, PPO, QRDQN, SAC, TD3, TQC, CrossQ, MaskablePPO, RecurrentPPO
from rejeu.buffers.hindsight import HerReplayBuffer

__all__ = [
    "A2C",
    "DDPG",
    "DQN",
    "PPO",
    "QRDQN",
    "SAC",
    "TD3",
    "TQC",
    "CrossQ",
    "HerReplayBuffer",
    "MaskablePPO",
    "RecurrentPPO",
]
