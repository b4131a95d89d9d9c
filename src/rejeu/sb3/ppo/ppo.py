"""Proximal policy optimisation."""

from rejeu.agents import PPO

__all__ = ["PPO"]
