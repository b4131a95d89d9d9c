"""The environment ``rejeu/ParkingHard-v0``: highway-env's parking-v0 with many parked cars and narrow slots."""

from __future__ import annotations

import numpy as np
from highway_env.envs.common.observation import KinematicsGoalObservation
from highway_env.envs.parking_env import ParkingEnv
from highway_env.road.lane import StraightLane

from rejeu.core.types import Settings

SLOTS, WIDTH = 18, 3.0
"""Slots of each of the two rows, and their width in meters; 14 of 4 m in parking-v0. A car is 2 m wide and 5 m long."""


class GoalObservation(KinematicsGoalObservation):
    """Observations with the numbers of highway-env's, without two data frames for each: they took two thirds of a step."""

    def observe(self) -> dict[str, np.ndarray]:
        car = self.observer_vehicle
        features = [[vehicle.to_dict()[feature] for feature in self.features] for vehicle in (car, car.goal)]
        achieved, desired = np.array(features) / self.scales
        return {"observation": achieved, "achieved_goal": achieved.copy(), "desired_goal": desired}


class ParkingHard(ParkingEnv):
    """Park in the one slot that is asked for, of 36 narrow ones of which 24 are taken.

    Observations, actions, rewards, walls and the end of episodes are those of parking-v0, whose ``config`` it takes as well.
    """

    def __init__(self, config: Settings | None = None, render_mode: str | None = None) -> None:
        super().__init__({"vehicles_count": 24, **(config or {})}, render_mode)

    def define_spaces(self) -> None:
        super().define_spaces()
        self.observation_type_parking = GoalObservation(self, **self.PARKING_OBS["observation"])
        if self.config["observation"]["type"] == "KinematicsGoal":
            self.observation_type = GoalObservation(self, **self.config["observation"])

    def _create_road(self, spots: int = SLOTS) -> None:
        super()._create_road(spots)
        network = self.road.network
        for (start, end, i), lane in network.lanes_dict().items():
            x = (i + 0.5 - spots / 2) * WIDTH
            ends = [x, lane.start[1]], [x, lane.end[1]]
            network.graph[start][end][i] = StraightLane(*ends, width=WIDTH, line_types=lane.line_types)

    def _create_vehicles(self) -> None:
        """Parked cars never move: as objects of the road they are hit like walls, and cost no simulation."""
        super()._create_vehicles()
        self.road.objects += self.road.vehicles[len(self.controlled_vehicles) :]
        self.road.vehicles = list(self.controlled_vehicles)
