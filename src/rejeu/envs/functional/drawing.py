"""Pictures of environments in JAX. Gymnasium's environments draw the states of their counterparts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs import classic_control

from rejeu.envs.canvas import Canvas, Drawing, Scene
from rejeu.envs.functional.ball_drawing import BallDrawing
from rejeu.envs.functional.parking import ROW_DISTANCE, spot
from rejeu.envs.functional.point_maze import RADIUS, TOLERANCE
from rejeu.envs.goal_camera import goal_camera
from rejeu.envs.registry import make_env

PAPER, INK, FAINT = (246, 246, 243), (52, 58, 70), (214, 225, 240)
AGENT, GOAL = (40, 104, 190), (38, 150, 96)


class GymnasiumDrawing(Drawing):
    """An environment of Gymnasium that draws our states."""

    def __init__(self, env: gym.Env) -> None:
        self.env: Any = env
        self.fps = env.metadata["render_fps"]

    def draw(self, scene: Scene) -> np.ndarray | None:
        state = scene.states[-1]
        self.env.state = np.concatenate([np.ravel(array) for array in state[:-1]], dtype=np.float64)  # without the time
        self.env.last_u = None if scene.action is None else float(np.ravel(scene.action)[0])  # only Pendulum reads it
        return self.env.render()

    def close(self) -> None:
        self.env.close()


def original(env_class: Callable[..., gym.Env], *fields: str) -> Callable[[Any, str], Drawing]:
    """Returns the drawing of an environment by one of Gymnasium, which gets these fields of ours."""

    def make(env: Any, render_mode: str) -> Drawing:
        return GymnasiumDrawing(env_class(render_mode=render_mode, **{name: getattr(env, name) for name in fields}))

    return make


acrobot = original(classic_control.AcrobotEnv)
cart_pole = original(classic_control.CartPoleEnv)
mountain_car = original(classic_control.MountainCarEnv, "goal_velocity")
pendulum = original(classic_control.PendulumEnv)


class ParkingLot(Drawing):
    """highway-env's ``parking-v0``, which draws our states."""

    fps = 5.0

    def __init__(self, env: Any, render_mode: str) -> None:
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
        picture = self.env.render()
        self.camera = goal_camera(self.env)
        return picture

    def close(self) -> None:
        self.env.close()


def ball(env: Any, render_mode: str) -> Drawing:
    """Returns the drawing of Ball."""
    return BallDrawing(env.dimension, env.max_episode_steps or 500, render_mode)


class Maze(Canvas):
    """A maze from above: walls, the goal with the distance at which it is reached, the way of the point."""

    CELL = 48
    """Width of a cell in pixels."""

    def __init__(self, env: Any, render_mode: str) -> None:
        self.walls = env.walls
        self.n_rows, self.n_columns = self.walls.shape
        super().__init__((self.n_columns * self.CELL, self.n_rows * self.CELL), render_mode, "PointMaze", 10.0)
        left, top = self._place(np.zeros(2))
        self.camera = np.array([[self.CELL, 0.0, left], [0.0, -self.CELL, top], [0.0, 0.0, 1.0]])

    def paint(self, scene: Scene) -> None:
        draw, cell, state = self.pygame.draw, self.CELL, scene.states[-1]
        self.surface.fill(PAPER)
        for row, column in np.argwhere(self.walls).tolist():
            draw.rect(self.surface, INK, (column * cell, (self.n_rows - 1 - row) * cell, cell, cell))
        draw.circle(self.surface, FAINT, self._place(state.goal), TOLERANCE * cell)
        draw.circle(self.surface, GOAL, self._place(state.goal), 0.1 * cell)
        if len(scene.states) > 1:
            draw.aalines(self.surface, AGENT, False, [self._place(visited.position) for visited in scene.states])
        draw.circle(self.surface, AGENT, self._place(state.position), RADIUS * cell)

    def _place(self, position: np.ndarray) -> tuple[float, float]:
        """Returns the pixel coordinates of a position in m from the middle."""
        x, y = float(position[0]), float(position[1])
        return (x + self.n_columns / 2) * self.CELL, (self.n_rows / 2 - y) * self.CELL


class Bits(Canvas):
    """Two rows of squares: the bits above, the goal below."""

    SQUARE = 40
    """Width of a square in pixels."""

    def __init__(self, env: Any, render_mode: str) -> None:
        super().__init__(((env.n_bits + 1) * self.SQUARE, 4 * self.SQUARE), render_mode, "BitFlipping", 4.0)

    def paint(self, scene: Scene) -> None:
        side, state = self.SQUARE, scene.states[-1]
        self.surface.fill(PAPER)
        for row, (bits, color) in enumerate([(state.bits, AGENT), (state.goal, GOAL)]):
            for i, bit in enumerate(bits.tolist()):
                square = ((i + 0.5) * side, (0.75 + 1.5 * row) * side, side - 4, side - 4)
                self.pygame.draw.rect(self.surface, color if bit else FAINT, square)
                if bool(bit) != bool(state.goal[i]) and row == 0:
                    self.pygame.draw.rect(self.surface, INK, square, width=3)
