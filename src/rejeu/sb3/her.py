"""Hindsight experience replay."""

from rejeu.buffers.hindsight import GoalSelectionStrategy
from rejeu.sb3 import alias
from rejeu.sb3.common.buffers import HerReplayBuffer

__all__ = ["GoalSelectionStrategy", "HerReplayBuffer"]
alias(__name__, "goal_selection_strategy", "her_replay_buffer")
