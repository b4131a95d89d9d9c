"""Soft actor-critic."""

from rejeu.agents import SAC

__all__ = ["SAC"]
