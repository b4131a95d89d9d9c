"""Pictures of environments in JAX. Gymnasium's environments draw the states of their counterparts."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.envs import classic_control

from rejeu.envs.functional.parking import ROW_DISTANCE, spot
from rejeu.envs.registry import make_env


class Scene(NamedTuple):
    """What there is to draw."""

    states: list[Any]
    """The states of the episode up to now, as NumPy arrays."""
    action: Any
    """The last action; None after a reset."""
    over: bool
    """Whether the episode has ended."""


class Drawing(ABC):
    """A picture, or a window, of an environment."""

    fps: float
    """Frames per second at which an episode is shown."""

    @abstractmethod
    def draw(self, scene: Scene) -> np.ndarray | None:
        """Returns ``uint8 (height, width, 3)``, or None if there is a window."""

    @abstractmethod
    def close(self) -> None:
        """Closes the window if there is one."""


class Original(Drawing):
    """An environment of Gymnasium that draws our states."""

    def __init__(self, env: gym.Env) -> None:
        self.env: Any = env
        self.fps = env.metadata["render_fps"]

    def draw(self, scene: Scene) -> np.ndarray | None:
        state = scene.states[-1]
        self.env.state = np.concatenate([np.ravel(part) for part in state[:-1]], dtype=np.float64)  # without the time
        self.env.last_u = None if scene.action is None else float(np.ravel(scene.action)[0])  # only Pendulum reads it
        return self.env.render()

    def close(self) -> None:
        self.env.close()


def cart_pole(env: Any, render_mode: str) -> Drawing:
    """Returns the drawing of CartPole."""
    return Original(classic_control.CartPoleEnv(render_mode=render_mode))


def pendulum(env: Any, render_mode: str) -> Drawing:
    """Returns the drawing of Pendulum."""
    return Original(classic_control.PendulumEnv(render_mode=render_mode))


def mountain_car(env: Any, render_mode: str) -> Drawing:
    """Returns the drawing of both MountainCars."""
    return Original(classic_control.MountainCarEnv(render_mode=render_mode, goal_velocity=env.goal_velocity))


def acrobot(env: Any, render_mode: str) -> Drawing:
    """Returns the drawing of Acrobot."""
    return Original(classic_control.AcrobotEnv(render_mode=render_mode))


class ParkingLot(Drawing):
    """highway-env's ``parking-v0``, which draws our states."""

    fps = 5.0

    def __init__(self, render_mode: str) -> None:
        """Makes the environment.

        Raises:
            MissingExtra: if highway-env is not installed.
        """
        self.env: Any = make_env("parking-v0", render_mode=render_mode).unwrapped

    def draw(self, scene: Scene) -> np.ndarray | None:
        state, vehicle = scene.states[-1], self.env.vehicle
        vehicle.position, vehicle.heading = state.position.astype(np.float64), float(state.heading)
        vehicle.speed, vehicle.crashed = float(state.speed), bool(state.crashed)
        x, side = spot(state.goal)
        vehicle.goal.position = np.array([float(x), ROW_DISTANCE * float(side)])
        vehicle.goal.heading = float(side) * np.pi / 2
        if scene.action is not None:
            vehicle.action = self.env.action_type.get_action(np.asarray(scene.action, np.float64))
        return self.env.render()

    def close(self) -> None:
        self.env.close()


def parking(env: Any, render_mode: str) -> Drawing:
    """Returns the drawing of Parking."""
    return ParkingLot(render_mode)
