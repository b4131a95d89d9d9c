"""Deep Q-learning."""

from rejeu.sb3 import alias
from rejeu.sb3.algorithms import DQN
from rejeu.sb3.common.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["DQN", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
alias(__name__, "dqn", "policies")
