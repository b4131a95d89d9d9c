"""Tuned hyperparameters as data (``presets.toml``), and their measured results.

>>> find("parking-v0").algorithm
'SAC'
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from rejeu.presets.preset import Preset, built_in, read, write
from rejeu.presets.result import Result, find_result, results

ALL: tuple[Preset, ...] = built_in()
"""Every preset of rejeu. The first one of an environment is the one that ``rejeu train`` uses."""

registered: dict[str, tuple[Preset, ...]] = {}
"""Presets of algorithms that are not rejeu's, by the name of the algorithm; see :func:`register`."""

TWINS = {
    "jax/Parking-v0": "parking-v0",
    "jax/Ball-v0": "rejeu/Ball-v0",
    "jax/Acrobot-v1": "Acrobot-v1",
    "jax/CartPole-v1": "CartPole-v1",
    "jax/Pendulum-v1": "Pendulum-v1",
    "jax/MountainCar-v0": "MountainCar-v0",
}
"""Environments in JAX that are equal to another environment, whose presets they have."""

ALGORITHM_FOR = {"Box": "SAC", "Discrete": "DQN", "MultiDiscrete": "PPO", "MultiBinary": "PPO"}
"""The default algorithm of an environment without a preset, by the class of its action space."""


def register(algorithm: str, presets: tuple[Preset, ...]) -> None:
    """Adds presets of an algorithm that is not rejeu's; see :func:`rejeu.register`."""
    registered[algorithm] = presets


def every() -> tuple[Preset, ...]:
    """Returns the presets of rejeu, and after them those that were registered."""
    return (*ALL, *(preset for presets in registered.values() for preset in presets))


def default(env_id: str, algorithm: str, hyperparameters: Mapping[str, Any] = MappingProxyType({})) -> Preset:
    """Returns a preset of the algorithm's defaults and ``hyperparameters``, for an environment that has no preset."""
    return Preset(
        env_id=env_id,
        algorithm=algorithm,
        hyperparameters=hyperparameters,
        n_envs=1,
        total_steps=100_000,
        evaluate_every=5_000,
        evaluate_episodes=20,
        source="the algorithm's defaults",
    )


def find(env_id: str, algorithm: str | None = None) -> Preset | None:
    """Returns the preset of an environment, the first one or that of ``algorithm``, or None if there is none.

    An environment in JAX that equals another one has its presets.

    >>> find("jax/Parking-v0").backend
    'jax'
    """
    found = next((p for p in every() if p.env_id == env_id and algorithm in (None, p.algorithm)), None)
    if found is not None or env_id not in TWINS:
        return found
    twin = find(TWINS[env_id], algorithm)
    return twin and dataclasses.replace(twin, env_id=env_id, backend="jax", source=f"the preset of {twin.env_id}")


__all__ = [
    "ALGORITHM_FOR",
    "ALL",
    "Preset",
    "Result",
    "default",
    "every",
    "find",
    "find_result",
    "read",
    "register",
    "results",
    "write",
]
