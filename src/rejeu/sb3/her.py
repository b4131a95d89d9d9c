"""Hindsight experience replay."""

from rejeu.buffers.hindsight import GoalSelectionStrategy, HerReplayBuffer
from rejeu.sb3 import alias

__all__ = ["GoalSelectionStrategy", "HerReplayBuffer"]
alias(__name__, "goal_selection_strategy", "her_replay_buffer")
