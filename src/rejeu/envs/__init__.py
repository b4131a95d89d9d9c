"""Environments: how rejeu steps many of them at once, and how goal environments compute rewards."""

import gymnasium as gym

from rejeu.envs import functional

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
