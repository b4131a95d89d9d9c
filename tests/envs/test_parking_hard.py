"""``rejeu/ParkingHard-v0``: what differs from highway-env's parking-v0, and what does not."""

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from tests.tiers import exhaustive

pytest.importorskip("highway_env")
from highway_env.envs.parking_env import ParkingEnv
from highway_env.vehicle.kinematics import Vehicle

from rejeu.envs.parking_hard import ParkingHard


class Simulated(ParkingHard):
    """The same with parked cars that are simulated like the agent's, and with the observations of highway-env."""

    def define_spaces(self) -> None:
        ParkingEnv.define_spaces(self)

    def _create_vehicles(self) -> None:
        ParkingEnv._create_vehicles(self)


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
    parked = [thing for thing in lot.road.objects if isinstance(thing, Vehicle)]
    assert lot.road.vehicles == [lot.vehicle]
    assert len(parked) == 24
    assert len({tuple(car.position) for car in parked}) == 24
    goal = lot.vehicle.goal.position
    assert min(np.linalg.norm(car.position - goal) for car in parked) >= 3.0


def test_parked_cars_are_hit_as_if_they_were_simulated():
    actions, ends = np.random.default_rng(0).uniform([0, -1], [1, 1], (4, 25, 2)), 0
    for seed, way in enumerate(actions):
        fast, slow = ParkingHard(), Simulated()
        fast.reset(seed=seed), slow.reset(seed=seed)
        for action in way:
            (one, reward, over, _, _), (two, expected, must_end, _, _) = fast.step(action), slow.step(action)
            tolerance = 0.01 if over else 0.0  # the last step goes on for a moment after the crash
            assert over == must_end
            np.testing.assert_allclose(reward, expected, rtol=0, atol=tolerance)
            assert fast.observation_space.contains(one)
            for key in ("observation", "achieved_goal", "desired_goal"):
                np.testing.assert_allclose(one[key], two[key], rtol=0, atol=tolerance)
            if over:
                break
        ends += fast.vehicle.crashed and any(car.crashed for car in fast.road.objects if isinstance(car, Vehicle))
    assert ends >= 2


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
