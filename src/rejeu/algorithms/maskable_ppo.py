"""PPO with invalid action masking.

Source: Huang and Ontanon 2022, "A Closer Look at Invalid Action Masking in Policy Gradient Algorithms" (arXiv
2006.14171): the logits of invalid actions are replaced by a large negative number before the softmax, when acting and when
learning, so that they have probability 0 and no gradient. Everything else is as in :mod:`rejeu.algorithms.ppo`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from rejeu.algorithms import ppo
from rejeu.algorithms.ppo import make

__all__ = ["Config", "make"]


@dataclass(frozen=True, kw_only=True)
class Config(ppo.Config):
    """Hyperparameters of PPO with ``action_masks=True``."""

    action_masks: bool = True

    name: ClassVar[str] = "MaskablePPO"
