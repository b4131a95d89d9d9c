"""Soft actor-critic."""

from rejeu.sb3 import alias
from rejeu.sb3.algorithms import SAC
from rejeu.sb3.common.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from rejeu.sb3.policy import Actor, SACPolicy

__all__ = ["SAC", "Actor", "CnnPolicy", "MlpPolicy", "MultiInputPolicy", "SACPolicy"]
alias(__name__, "sac", "policies")
