"""The best weights of a run so far: when they are kept, and how they are put back."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rejeu.loops import finite
from rejeu.loops.learner import PackedState
from rejeu.reporting.text import counted

if TYPE_CHECKING:
    from rejeu.agents.base import Agent

BEST_WINDOW = 20
"""Training episodes over whose mean return the best weights are judged by default."""


class Best(NamedTuple):
    """The best weights of a run so far."""

    score: float | tuple[float, ...]
    """Mean training return, or what evaluations are judged by: success rate and mean return."""
    by: str
    """``"training"`` or ``"evaluation"``."""
    step: int
    """Environment steps taken when they were kept."""
    state: PackedState
    """The algorithm's whole state at that moment, packed."""


def note_training_return(agent: Agent, ended: int) -> None:
    """Keeps the present weights if ``ended`` episodes that have just ended bring the best mean return so far.

    Where several ended at once, each of them closes a window of its own.
    """
    window = agent.best_window
    returns = [episode.episode_return for episode in agent.history.last(window + ended - 1)]
    if len(returns) >= window and (agent.best is None or agent.best.by == "training"):
        means = np.lib.stride_tricks.sliding_window_view(returns, window).mean(axis=-1)
        agent.remember_best(float(means.max()), "training")


def remember(agent: Agent, score: float | tuple[float, ...], by: str) -> bool:
    """Keeps the present weights if ``score`` is the best of its kind so far; returns whether it is."""
    if agent.best is not None and agent.best.by == by and score <= agent.best.score:  # type: ignore[operator]
        return False
    finite.settle(agent)
    agent.best = Best(score, by, agent.run.step, agent.learner.copy(agent.run.state))
    return True


def restore(agent: Agent) -> None:
    """Puts the best weights back.

    Raises:
        ValueError: if none were kept yet.
    """
    if agent.best is None:
        raise ValueError(
            f"no best weights are known yet: they are kept once {counted(agent.best_window, 'episode')} of training "
            "ended, and at every evaluation by rejeu.callbacks.Evaluate"
        )
    agent.run.state = agent.learner.copy(agent.best.state)
    agent._drop_rollout()
