"""Environments: how rejeu steps many of them at once, and how goal environments compute rewards."""

import gymnasium as gym

from rejeu.envs.make import VectorEnv, make_vector

if "rejeu/Ball-v0" not in gym.registry:
    gym.register("rejeu/Ball-v0", "rejeu.envs.ball.ball:Ball", max_episode_steps=500)
if "rejeu/CartPoleNoVelocity-v0" not in gym.registry:
    gym.register(
        "rejeu/CartPoleNoVelocity-v0",
        "rejeu.envs.partially_observable:cart_pole_without_velocities",
        max_episode_steps=500,
        reward_threshold=475.0,
    )

__all__ = ["VectorEnv", "make_vector"]
