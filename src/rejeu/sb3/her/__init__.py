"""Hindsight experience replay."""

from rejeu.replay.hindsight import GoalSelectionStrategy, HerReplayBuffer

__all__ = ["GoalSelectionStrategy", "HerReplayBuffer"]
