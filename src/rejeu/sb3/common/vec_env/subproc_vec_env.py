"""One of the vector environments."""

from rejeu.envs.subproc import SubprocVecEnv

__all__ = ["SubprocVecEnv"]
