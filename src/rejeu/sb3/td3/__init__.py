"""Twin delayed DDPG."""

from rejeu.agents import TD3
from rejeu.sb3.common.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["TD3", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
