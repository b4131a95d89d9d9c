"""The base class of the algorithms."""

from rejeu.agents import Agent as BaseAlgorithm

__all__ = ["BaseAlgorithm"]
