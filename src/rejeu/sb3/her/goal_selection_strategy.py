"""Where the goals of hindsight come from."""

from rejeu.buffers.hindsight import GoalSelectionStrategy

__all__ = ["GoalSelectionStrategy"]
