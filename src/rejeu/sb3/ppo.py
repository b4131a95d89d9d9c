"""Proximal policy optimization."""

from rejeu.sb3 import alias
from rejeu.sb3.algorithms import PPO
from rejeu.sb3.common.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["PPO", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
alias(__name__, "ppo", "policies")
