"""The algorithms with Stable-Baselines3's schedules: functions of the progress that remains, which runs from 1 to 0."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rejeu import agents
from rejeu.sb3.common.utils import of_progress

SCHEDULED = ("learning_rate", "clip_range", "clip_range_vf", "ent_coef", "critic_learning_rate", "beta")
"""The hyperparameters that can be schedules."""


def converted(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns keyword arguments of an agent whose schedules are functions of the progress."""
    result = {key: of_progress(value) if key in SCHEDULED else value for key, value in settings.items()}
    if isinstance(result.get("priorities"), Mapping):
        result["priorities"] = converted(result["priorities"])
    return result


class A2C(agents.A2C):
    """:class:`rejeu.A2C`; functions given as schedules take the remaining progress."""

    converted = staticmethod(converted)


class DDPG(agents.DDPG):
    """:class:`rejeu.DDPG`; functions given as schedules take the remaining progress."""

    converted = staticmethod(converted)


class DQN(agents.DQN):
    """:class:`rejeu.DQN`; functions given as schedules take the remaining progress."""

    converted = staticmethod(converted)


class PPO(agents.PPO):
    """:class:`rejeu.PPO`; functions given as schedules take the remaining progress."""

    converted = staticmethod(converted)


class QRDQN(agents.QRDQN):
    """:class:`rejeu.QRDQN`; functions given as schedules take the remaining progress."""

    converted = staticmethod(converted)


class SAC(agents.SAC):
    """:class:`rejeu.SAC`; functions given as schedules take the remaining progress."""

    converted = staticmethod(converted)


class TD3(agents.TD3):
    """:class:`rejeu.TD3`; functions given as schedules take the remaining progress."""

    converted = staticmethod(converted)


class TQC(agents.TQC):
    """:class:`rejeu.TQC`; functions given as schedules take the remaining progress."""

    converted = staticmethod(converted)


class CrossQ(agents.CrossQ):
    """:class:`rejeu.CrossQ`; functions given as schedules take the remaining progress."""

    converted = staticmethod(converted)


class MaskablePPO(agents.MaskablePPO):
    """:class:`rejeu.MaskablePPO`; functions given as schedules take the remaining progress."""

    converted = staticmethod(converted)


class RecurrentPPO(agents.RecurrentPPO):
    """:class:`rejeu.RecurrentPPO`; functions given as schedules take the remaining progress."""

    converted = staticmethod(converted)


__all__ = ["A2C", "DDPG", "DQN", "PPO", "QRDQN", "SAC", "TD3", "TQC", "CrossQ", "MaskablePPO", "RecurrentPPO"]
