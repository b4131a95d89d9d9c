"""Deep deterministic policy gradient."""

from rejeu.agents import DDPG

__all__ = ["DDPG"]
