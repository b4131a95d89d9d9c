"""Deep Q-learning."""

from rejeu.agents import DQN

__all__ = ["DQN"]
