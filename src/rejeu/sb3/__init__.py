"""Stable-Baselines3's module paths, leading to rejeu.

A script moves over by replacing ``stable_baselines3`` by ``rejeu.sb3`` in its imports. Nothing is defined here; what
rejeu does not have cannot be imported. The algorithms of sb3-contrib (``QRDQN``, ``TQC``, ``CrossQ``) stand beside the others.

>>> from rejeu.sb3 import SAC, HerReplayBuffer
>>> from rejeu.sb3.common.noise import NormalActionNoise
"""

from rejeu.agents import DDPG, DQN, QRDQN, SAC, TD3, TQC, CrossQ
from rejeu.replay.hindsight import HerReplayBuffer

__all__ = ["DDPG", "DQN", "QRDQN", "SAC", "TD3", "TQC", "CrossQ", "HerReplayBuffer"]
