"""Advantage actor-critic."""

from rejeu.sb3 import alias
from rejeu.sb3.algorithms import A2C
from rejeu.sb3.common.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["A2C", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
alias(__name__, "a2c", "policies")
