"""Randomized ensembled double Q-learning: SAC that takes many gradient steps of many critics for each environment step.

Source: Chen et al. 2021, "Randomized Ensembled Double Q-Learning: Learning Fast Without a Model" (arXiv 2101.05982,
algorithm 1). Each of ``G`` gradient steps draws a set of ``M`` of the ``N`` critics; with policy ``pi``, temperature ``alpha``
and discount ``d`` (0 where the MDP terminated)::

    y    = r + d (min_{i in M} q'_i(s', a') - alpha log pi(a' | s')),     a' ~ pi(. | s')
    J_Q  = sum_i mean (q_i(s, a) - y)^2,                                  for all N critics
    J_pi = mean (alpha log pi(a | s) - mean_i q_i(s, a)),                 after the last of the G steps

The functions are those of :mod:`rejeu.algorithms.sac`, of which these are settings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from rejeu.algorithms import sac
from rejeu.algorithms.sac import make

__all__ = ["Config", "make"]


@dataclass(frozen=True, kw_only=True)
class Config(sac.Config):
    """Hyperparameters of REDQ: those of SAC. The defaults are those of the paper."""

    n_critics: int = 10
    target_subset: int | None = 2
    gradient_steps: int = 20
    policy_delay: int = 20
    learning_starts: int = 5000

    name: ClassVar[str] = "REDQ"
