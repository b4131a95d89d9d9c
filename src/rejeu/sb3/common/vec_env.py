"""Vector environments that reset themselves."""

from rejeu.envs.auto_reset import DummyVecEnv, VecVideoRecorder

__all__ = ["DummyVecEnv", "VecVideoRecorder"]
