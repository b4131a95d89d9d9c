"""Twin delayed DDPG."""

from rejeu.agents import TD3

__all__ = ["TD3"]
