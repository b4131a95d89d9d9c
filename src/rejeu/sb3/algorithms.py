"""The algorithms with Stable-Baselines3's schedules: functions of the progress that remains, which runs from 1 to 0."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rejeu import agents
from rejeu.sb3.common.utils import of_progress

if TYPE_CHECKING:
    from rejeu.agents import A2C, DDPG, DQN, PPO, QRDQN, SAC, TD3, TQC, CrossQ, MaskablePPO, RecurrentPPO

__all__ = ["A2C", "DDPG", "DQN", "PPO", "QRDQN", "SAC", "TD3", "TQC", "CrossQ", "MaskablePPO", "RecurrentPPO"]

SCHEDULED = ("learning_rate", "clip_range", "clip_range_vf", "ent_coef", "critic_learning_rate", "beta")
"""The hyperparameters that can be schedules."""


def converted(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns keyword arguments of an agent whose schedules are functions of the progress."""
    result = {key: of_progress(value) if key in SCHEDULED else value for key, value in settings.items()}
    if isinstance(result.get("priorities"), Mapping):
        result["priorities"] = converted(result["priorities"])
    return result


def with_remaining_progress(kind: Any) -> Any:
    """Returns the subclass of an agent whose schedules that are functions take the remaining progress."""
    doc = f":class:`rejeu.{kind.__name__}`; functions given as schedules take the remaining progress."
    attributes = {"__module__": __name__, "__doc__": doc, "converted": staticmethod(converted)}
    return type(kind)(kind.__name__, (kind,), attributes)


if not TYPE_CHECKING:
    for name in __all__:
        globals()[name] = with_remaining_progress(getattr(agents, name))
