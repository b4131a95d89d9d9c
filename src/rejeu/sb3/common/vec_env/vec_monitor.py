"""One of the vector environments."""

from rejeu.envs.vec_wrappers import VecMonitor

__all__ = ["VecMonitor"]
