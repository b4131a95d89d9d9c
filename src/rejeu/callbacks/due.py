"""Whether something that happens at an interval of steps is due."""

from __future__ import annotations

from rejeu.callbacks.base import TrainedAgent
from rejeu.loops.run import Progress


def crossed(before: int, now: int, every: int) -> bool:
    """Returns whether a multiple of ``every`` lies in ``(before, now]``.

    >>> [now for now in range(8, 41, 8) if crossed(now - 8, now, 10)]
    [16, 24, 32, 40]
    """
    return now // every > before // every


def step_before(agent: TrainedAgent, progress: Progress, n_steps: int | None = None) -> int:
    """Returns the total environment steps before the first turn of a ``learn`` of ``n_steps`` (None: of more than a turn)."""
    taken = agent.n_envs if n_steps is None else min(agent.n_envs, n_steps)
    return max(progress.step - taken, 0)
