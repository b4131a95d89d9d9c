"""What all agents share."""

from rejeu.agents import Agent as BaseAlgorithm

__all__ = ["BaseAlgorithm"]
