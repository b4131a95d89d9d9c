"""Soft actor-critic."""

from rejeu.sb3 import alias
from rejeu.sb3.algorithms import SAC
from rejeu.sb3.common.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["SAC", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
alias(__name__, "sac", "policies")
