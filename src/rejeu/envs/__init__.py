"""Environments: how rejeu steps many of them at once, and how goal environments compute rewards."""

import importlib
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from rejeu.envs import functional

if TYPE_CHECKING:
    from rejeu.envs.make import VectorEnv, make_vector

if "rejeu/Ball-v0" not in gym.registry:
    gym.register("rejeu/Ball-v0", "rejeu.teaching.ball:Ball", max_episode_steps=500)
if "rejeu/CartPoleNoVelocity-v0" not in gym.registry:
    gym.register(
        "rejeu/CartPoleNoVelocity-v0",
        "rejeu.envs.wrappers:cart_pole_without_velocities",
        max_episode_steps=500,
        reward_threshold=475.0,
    )
if "rejeu/ParkingHard-v0" not in gym.registry:
    gym.register("rejeu/ParkingHard-v0", "rejeu.envs.parking_hard:ParkingHard")

functional.register_with_gymnasium()

__all__ = ["VectorEnv", "make_vector"]

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Imports vector environments when they are first used, so that registering environments alone is quick."""
        if name not in __all__:
            raise AttributeError(f"module 'rejeu.envs' has no attribute {name!r}")
        return getattr(importlib.import_module("rejeu.envs.make"), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
