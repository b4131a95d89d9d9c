"""Action noise."""

from rejeu.exploration.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise

__all__ = ["ActionNoise", "NormalActionNoise", "OrnsteinUhlenbeckActionNoise"]
