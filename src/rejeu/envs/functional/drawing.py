"""Pictures of environments in JAX. Gymnasium's environments draw the states of their counterparts."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.envs import classic_control

from rejeu.envs.functional.parking import ROW_DISTANCE, spot
from rejeu.envs.functional.point_maze import RADIUS, TOLERANCE
from rejeu.envs.registry import make_env
from rejeu.errors import MissingExtra

PAPER, INK, FAINT = (246, 246, 243), (52, 58, 70), (214, 225, 240)
AGENT, GOAL = (40, 104, 190), (38, 150, 96)


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


class Canvas(Drawing):
    """A surface of pygame on which subclasses draw; a window for the render mode ``human``."""

    def __init__(self, size: tuple[int, int], render_mode: str, title: str, fps: float) -> None:
        """Prepares the surface, ``size`` pixels wide and high.

        Raises:
            MissingExtra: if pygame is not installed.
        """
        try:
            import pygame
        except ImportError:
            raise MissingExtra(f"drawing {title}", "pygame-ce", "play") from None
        self.pygame: Any = pygame
        self.fps = fps
        self.surface = pygame.Surface(size)
        self.window: Any = None
        self.clock = pygame.time.Clock()
        if render_mode == "human":
            pygame.display.init()
            pygame.display.set_caption(title)
            self.window = pygame.display.set_mode(size)

    @abstractmethod
    def paint(self, scene: Scene) -> None:
        """Draws on the surface."""

    def draw(self, scene: Scene) -> np.ndarray | None:
        self.paint(scene)
        if self.window is None:
            return np.ascontiguousarray(self.pygame.surfarray.array3d(self.surface).swapaxes(0, 1))
        self.pygame.event.pump()
        self.window.blit(self.surface, (0, 0))
        self.pygame.display.flip()
        self.clock.tick(self.fps)
        return None

    def close(self) -> None:
        if self.window is not None:
            self.pygame.display.quit()
            self.window = None


class Maze(Canvas):
    """A maze from above: walls, the goal with the distance at which it is reached, the way of the point."""

    CELL = 48
    """Width of a cell in pixels."""

    def __init__(self, env: Any, render_mode: str) -> None:
        self.walls = env.walls
        self.n_rows, self.n_columns = self.walls.shape
        super().__init__((self.n_columns * self.CELL, self.n_rows * self.CELL), render_mode, "PointMaze", 10.0)

    def paint(self, scene: Scene) -> None:
        draw, cell, state = self.pygame.draw, self.CELL, scene.states[-1]
        self.surface.fill(PAPER)
        for row, column in np.argwhere(self.walls).tolist():
            draw.rect(self.surface, INK, (column * cell, (self.n_rows - 1 - row) * cell, cell, cell))
        draw.circle(self.surface, FAINT, self._place(state.goal), TOLERANCE * cell)
        draw.circle(self.surface, GOAL, self._place(state.goal), 0.1 * cell)
        if len(scene.states) > 1:
            draw.aalines(self.surface, AGENT, False, [self._place(one.position) for one in scene.states])
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
                place = ((i + 0.5) * side, (0.75 + 1.5 * row) * side, side - 4, side - 4)
                self.pygame.draw.rect(self.surface, color if bit else FAINT, place)
                if bool(bit) != bool(state.goal[i]) and row == 0:
                    self.pygame.draw.rect(self.surface, INK, place, width=3)
