"""Hindsight experience replay."""

from rejeu.buffers.hindsight import GoalSelectionStrategy, HerReplayBuffer

__all__ = ["GoalSelectionStrategy", "HerReplayBuffer"]
