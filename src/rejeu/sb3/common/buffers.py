"""Replay buffers."""

from rejeu.replay.uniform import ReplayBuffer

__all__ = ["ReplayBuffer"]
