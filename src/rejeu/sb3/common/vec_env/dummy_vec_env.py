"""One of the vector environments."""

from rejeu.envs.auto_reset import DummyVecEnv

__all__ = ["DummyVecEnv"]
