"""Where the goals of hindsight come from."""

from rejeu.replay.hindsight import GoalSelectionStrategy

__all__ = ["GoalSelectionStrategy"]
