"""Watching episodes."""

from rejeu.envs.monitor import Monitor

__all__ = ["Monitor"]
