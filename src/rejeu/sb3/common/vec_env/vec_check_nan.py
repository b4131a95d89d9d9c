"""One of the vector environments."""

from rejeu.envs.vec_wrappers import VecCheckNan

__all__ = ["VecCheckNan"]
