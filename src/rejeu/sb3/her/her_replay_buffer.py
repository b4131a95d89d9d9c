"""The buffer of hindsight replay."""

from rejeu.buffers.hindsight import HerReplayBuffer

__all__ = ["HerReplayBuffer"]
