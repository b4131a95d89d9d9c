"""Goal selection strategies of hindsight experience replay."""

from rejeu.buffers.hindsight import GoalSelectionStrategy

__all__ = ["GoalSelectionStrategy"]
