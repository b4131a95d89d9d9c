"""Tuned hyper-parameters as data, one file a family of environments.

>>> find("parking-v0").algorithm
'SAC'
"""

from __future__ import annotations

from rejeu.presets import ball, box2d, classic_control, parking, robotics
from rejeu.presets.preset import Preset, results

ALL: tuple[Preset, ...] = (*parking.PRESETS, *classic_control.PRESETS, *box2d.PRESETS, *ball.PRESETS, *robotics.PRESETS)
"""Every preset; of several for one environment the first is the best."""

ALGORITHM_FOR = {"Box": "SAC", "Discrete": "DQN", "MultiDiscrete": "PPO", "MultiBinary": "PPO"}
"""The algorithm to begin with in an environment without a preset, by the class of its action space."""


def default(env_id: str, algorithm: str) -> Preset:
    """Returns what an environment without a preset is trained with: the algorithm's own defaults."""
    return Preset(
        env_id=env_id,
        algorithm=algorithm,
        hyperparameters={},
        n_envs=1,
        total_steps=100_000,
        evaluate_every=5_000,
        evaluate_episodes=20,
        source="the algorithm's defaults",
    )


def find(env_id: str, algorithm: str | None = None) -> Preset | None:
    """Returns the preset of an environment, the best or that of ``algorithm``, or None where there is none."""
    return next((p for p in ALL if p.env_id == env_id and algorithm in (None, p.algorithm)), None)


__all__ = ["ALGORITHM_FOR", "ALL", "Preset", "default", "find", "results"]
