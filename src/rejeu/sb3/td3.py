"""Twin delayed DDPG."""

from rejeu.sb3 import alias
from rejeu.sb3.algorithms import TD3
from rejeu.sb3.common.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from rejeu.sb3.policy import Actor, TD3Policy

__all__ = ["TD3", "Actor", "CnnPolicy", "MlpPolicy", "MultiInputPolicy", "TD3Policy"]
alias(__name__, "td3", "policies")
