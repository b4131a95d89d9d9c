"""The best weights of a run so far: when they are kept, and how they are put back."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rejeu import finite
from rejeu.loops.compiled import PackedState

if TYPE_CHECKING:
    from rejeu.agents.base import Agent

BEST_WINDOW = 20
"""Training episodes over whose mean return the best weights are judged."""


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


def note_training_return(agent: Agent) -> None:
    """Keeps the present weights if the mean of the last episodes' returns is the best so far."""
    returns = [episode.episode_return for episode in agent.history.last(BEST_WINDOW)]
    if len(returns) == BEST_WINDOW and (agent.best is None or agent.best.by == "training"):
        agent.remember_best(float(np.mean(returns)), "training")


def remember(agent: Agent, score: float | tuple[float, ...], by: str) -> bool:
    """Keeps the present weights if ``score`` is the best of its kind so far; returns whether it is."""
    if agent.best is not None and agent.best.by == by and score <= agent.best.score:  # type: ignore[operator]
        return False
    finite.settle(agent)
    agent.best = Best(score, by, agent._run.step, agent._compiled.copy(agent._run.state))
    return True


def restore(agent: Agent) -> None:
    """Puts the best weights back.

    Raises:
        ValueError: if none were kept yet.
    """
    if agent.best is None:
        raise ValueError(
            f"no best weights are known yet: they are kept from the {BEST_WINDOW}th finished episode on, and at every "
            "evaluation by rejeu.callbacks.Evaluate"
        )
    agent._run.state = agent._compiled.copy(agent.best.state)
