"""The buffer of hindsight replay."""

from rejeu.replay.hindsight import HerReplayBuffer

__all__ = ["HerReplayBuffer"]
