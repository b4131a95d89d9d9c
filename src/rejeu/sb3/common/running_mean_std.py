"""Running moments."""

from rejeu.envs.vec_normalize import RunningMeanStd

__all__ = ["RunningMeanStd"]
