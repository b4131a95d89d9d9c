"""``rejeu/Ball-v0``: keep a randomly moving ball inside a box."""

from rejeu.envs.ball.ball import Ball

__all__ = ["Ball"]
