"""One of the vector environments."""

from rejeu.envs.vec_wrappers import VecTransposeImage

__all__ = ["VecTransposeImage"]
