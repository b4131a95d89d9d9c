"""Soft actor-critic."""

from rejeu.agents import SAC
from rejeu.sb3.common.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["SAC", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
