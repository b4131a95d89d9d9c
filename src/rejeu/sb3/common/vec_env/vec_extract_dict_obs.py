"""One of the vector environments."""

from rejeu.envs.vec_wrappers import VecExtractDictObs

__all__ = ["VecExtractDictObs"]
