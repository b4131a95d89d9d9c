"""One of the vector environments."""

from rejeu.envs.vec_normalize import VecNormalize

__all__ = ["VecNormalize"]
