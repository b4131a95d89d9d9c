"""Twin delayed DDPG."""

from rejeu.sb3 import alias
from rejeu.sb3.algorithms import TD3
from rejeu.sb3.common.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["TD3", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
alias(__name__, "td3", "policies")
