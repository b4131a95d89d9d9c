"""Advantage actor-critic."""

from rejeu.agents import A2C

__all__ = ["A2C"]
