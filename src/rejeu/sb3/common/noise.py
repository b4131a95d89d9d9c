"""Noise on actions."""

from rejeu.exploration.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise

__all__ = ["NormalActionNoise", "OrnsteinUhlenbeckActionNoise"]
