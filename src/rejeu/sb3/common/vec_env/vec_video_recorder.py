"""One of the vector environments."""

from rejeu.envs.auto_reset import VecVideoRecorder

__all__ = ["VecVideoRecorder"]
