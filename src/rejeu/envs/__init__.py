"""Environments: how rejeu steps many of them at once, and how goal environments compute rewards."""

from rejeu.envs.vector import VectorEnv, make_vector

__all__ = ["VectorEnv", "make_vector"]
