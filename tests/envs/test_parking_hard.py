"""``rejeu/ParkingHard-v0``: what differs from highway-env's parking-v0, and what does not."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from tests.tiers import exhaustive

pytest.importorskip("highway_env")


def test_the_slots_are_narrow_and_most_are_taken():
    env = gym.make("rejeu/ParkingHard-v0")
    env.reset(seed=0)
    lot = env.unwrapped
    slots = lot.road.network.lanes_dict().values()
    assert len(slots) == 36
    assert {slot.width for slot in slots} == {3.0}
    middles = sorted({float(slot.start[0]) for slot in slots})
    np.testing.assert_allclose(np.diff(middles), 3.0)
    assert middles[0] == -middles[-1]
    parked = [car for car in lot.road.vehicles if car is not lot.vehicle]
    assert len(parked) == 24
    assert len({tuple(car.position) for car in parked}) == 24
    goal = lot.vehicle.goal.position
    assert min(np.linalg.norm(car.position - goal) for car in parked) >= 3.0


def test_it_is_parking_otherwise_and_equal_for_equal_seeds():
    hard, plain = gym.make("rejeu/ParkingHard-v0"), gym.make("rejeu/ParkingHard-v0", config={"vehicles_count": 0})
    for key in ("add_walls", "duration", "reward_weights", "success_goal_reward", "collision_reward"):
        assert hard.unwrapped.config[key] == plain.unwrapped.config[key]
    one, two = (hard.reset(seed=3)[0] for _ in range(2))
    for key in ("observation", "achieved_goal", "desired_goal"):
        np.testing.assert_array_equal(one[key], two[key])
    plain.reset(seed=3)
    assert len(plain.unwrapped.road.vehicles) == 1


@exhaustive
def test_hindsight_works_in_it():
    settings = {"replay_buffer_class": "HerReplayBuffer", "learning_starts": 20, "batch_size": 8}
    agent = rejeu.SAC("MultiInputPolicy", "rejeu/ParkingHard-v0", policy_kwargs={"net_arch": [8]}, seed=0, **settings)
    assert agent.learn(40).n_updates > 0
