"""When what happens every so many steps falls due."""

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
    """Returns the step count before this first turn of a run that takes ``n_steps`` (None: more than one turn's)."""
    taken = agent.n_envs if n_steps is None else min(agent.n_envs, n_steps)
    return max(progress.step - taken, 0)
