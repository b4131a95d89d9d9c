"""PPO where only some actions are allowed.

Source: Huang and Ontanon 2022, "A Closer Look at Invalid Action Masking in Policy Gradient Algorithms" (arXiv
2006.14171): the logits of forbidden actions are replaced by a large negative number before the softmax, when acting as when
learning, so that they are never drawn, get no probability and no gradient. All else is :mod:`rejeu.algorithms.ppo`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from rejeu.algorithms import ppo
from rejeu.algorithms.ppo import make

__all__ = ["Config", "make"]


@dataclass(frozen=True, kw_only=True)
class Config(ppo.Config):
    """Hyper-parameters of PPO with action masks; those of PPO."""

    name: ClassVar[str] = "MaskablePPO"
