"""Proximal policy optimization."""

from rejeu.agents import PPO

__all__ = ["PPO"]
