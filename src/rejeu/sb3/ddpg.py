"""Deep deterministic policy gradient."""

from rejeu.sb3 import alias
from rejeu.sb3.algorithms import DDPG
from rejeu.sb3.common.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from rejeu.sb3.policy import TD3Policy

__all__ = ["DDPG", "CnnPolicy", "MlpPolicy", "MultiInputPolicy", "TD3Policy"]
alias(__name__, "ddpg", "policies")
