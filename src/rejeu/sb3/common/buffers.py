"""Replay buffers."""

from rejeu.buffers.uniform import ReplayBuffer

__all__ = ["ReplayBuffer"]
