"""Deep Q-learning."""

from rejeu.sb3 import alias
from rejeu.sb3.algorithms import DQN
from rejeu.sb3.common.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from rejeu.sb3.policy import DQNPolicy, QNetwork

__all__ = ["DQN", "CnnPolicy", "DQNPolicy", "MlpPolicy", "MultiInputPolicy", "QNetwork"]
alias(__name__, "dqn", "policies")
