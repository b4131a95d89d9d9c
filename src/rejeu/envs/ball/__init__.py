"""``rejeu/Ball-v0``: a ball that is pushed to a place on a strip."""

from rejeu.envs.ball.ball import Ball

__all__ = ["Ball"]
