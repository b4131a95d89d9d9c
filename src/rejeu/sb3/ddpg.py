"""Deep deterministic policy gradient."""

from rejeu.sb3 import alias
from rejeu.sb3.algorithms import DDPG
from rejeu.sb3.common.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["DDPG", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
alias(__name__, "ddpg", "policies")
