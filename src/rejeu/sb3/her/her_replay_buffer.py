"""The hindsight replay buffer."""

from rejeu.buffers.hindsight import HerReplayBuffer

__all__ = ["HerReplayBuffer"]
