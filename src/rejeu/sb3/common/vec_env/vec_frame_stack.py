"""One of the vector environments."""

from rejeu.envs.vec_wrappers import VecFrameStack

__all__ = ["VecFrameStack"]
