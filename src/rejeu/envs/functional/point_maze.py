"""A point that is pushed through a maze to a goal: ``jax/PointMaze-v0``."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array

from rejeu.core.spaces import GOAL_KEYS
from rejeu.core.validation import choice
from rejeu.envs.functional.protocol import GoalEnv, time_is_up

LAYOUTS = tomllib.loads(Path(__file__).with_name("mazes.toml").read_text(encoding="utf-8"))
"""Walls (#) and free cells (.) of the mazes. A cell is 1 m wide."""
RADIUS = 0.1
"""Half of the width of the point, in m."""
TIME_STEP, ACCELERATION, DRAG = 0.1, 5.0, 1.0
"""Length of a step in s, strongest acceleration in m/s^2, and deceleration per speed in 1/s: the speed stays below 5 m/s."""
MAX_SPEED = ACCELERATION / DRAG
SPREAD = 0.25
"""Largest distance of starts and goals from the middle of a cell, in x and y."""
TOLERANCE = 0.45
"""Distance from the goal at which it is reached."""
MARGIN = 1e-4
"""Distance from a wall at which the point stops."""


class State(NamedTuple):
    """Position and velocity of the point, the goal, and the number of steps of the episode."""

    position: Array
    """``float (2,)``, in m from the middle of the maze; y points up."""
    velocity: Array
    """``float (2,)``, in m/s."""
    goal: Array
    """``float (2,)``."""
    time: Array
    """``int32 ()``."""


class PointMaze(GoalEnv):
    """A point is accelerated through a maze to a random goal, as in Gymnasium-Robotics' PointMaze.

    Actions are accelerations in x and y, in [-1, 1]; observations are position and velocity; goals are positions. The reward
    is 0 within 0.45 m of the goal, where the episode terminates, and -1 elsewhere. The point starts at rest in a random cell.

    What differs from Gymnasium-Robotics: the physics are those of a square that slides along walls and stops at them, not
    MuJoCo's; a step takes 0.1 s; rewards are -1 and 0, not 0 and 1; and the episode ends at the goal.

    Args:
        layout: ``"open"``, ``"u"``, ``"medium"`` or ``"large"``; the walls are those of :data:`LAYOUTS`.

    Raises:
        ValueError: for an unknown layout.
    """

    layout: str = eqx.field(static=True, default="u")
    max_episode_steps: int | None = eqx.field(static=True, default=200)

    def __check_init__(self) -> None:
        choice("layout", self.layout, LAYOUTS)

    @property
    def observation_space(self) -> spaces.Dict:
        goal: np.ndarray = np.array(self.walls.shape[::-1], np.float32) / 2
        high = np.array([*goal, MAX_SPEED, MAX_SPEED], np.float32)
        bounds = zip(GOAL_KEYS, (high, goal, goal), strict=True)
        return spaces.Dict({key: spaces.Box(-bound, bound) for key, bound in bounds})

    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    @property
    def walls(self) -> np.ndarray:
        """Which cells are walls, ``bool (n_rows, n_columns)``; the first row is at the bottom."""
        rows = LAYOUTS[self.layout].split()
        return np.array([[cell == "#" for cell in row] for row in reversed(rows)])

    def reset(self, key: Array) -> tuple[State, dict[str, Array]]:
        start_key, goal_key, spread_key = jax.random.split(key, 3)
        cells = np.argwhere(~self.walls)[:, ::-1]
        start = jax.random.randint(start_key, (), 0, len(cells))
        goal = jax.random.randint(goal_key, (), 0, len(cells) - 1)
        ends = jnp.stack([start, goal + (goal >= start)])
        off = jax.random.uniform(spread_key, (2, 2), minval=-SPREAD, maxval=SPREAD)
        middle = jnp.asarray(cells - np.array(self.walls.shape[::-1]) / 2 + 0.5, off.dtype)
        position, goal = middle[ends] + off
        state = State(position, jnp.zeros(2), goal, jnp.zeros((), jnp.int32))
        return state, observe(state)

    def step(self, key: Array, state: State, action: Array) -> tuple[State, dict[str, Array], Array, Array, Array]:
        push = ACCELERATION * jnp.clip(action, -1.0, 1.0) - DRAG * state.velocity
        position, velocity = self.slide(state.position, state.velocity + TIME_STEP * push)
        after = State(position, velocity, state.goal, state.time + 1)
        reward = self.compute_reward(after.position, after.goal)
        truncated = time_is_up(after.time, self.max_episode_steps)
        return after, observe(after), reward, self.success(after), truncated

    def compute_reward(self, achieved_goal: Array, desired_goal: Array, info: object = None) -> Array:
        return self.compute_terminated(achieved_goal, desired_goal).astype(float) - 1.0

    def compute_terminated(self, achieved_goal: Array, desired_goal: Array, info: object = None) -> Array:
        difference = achieved_goal - desired_goal
        return jnp.hypot(difference[..., 0], difference[..., 1]) <= TOLERANCE

    def success(self, state: State) -> Array:
        return self.compute_terminated(state.position, state.goal)

    def slide(self, position: Array, velocity: Array) -> tuple[Array, Array]:
        """Returns position and velocity after a step: first along x, then along y, each up to the next wall."""
        n_rows, n_columns = self.walls.shape
        x, y = position[0] + n_columns / 2, position[1] + n_rows / 2  # in cells, from the lower left corner
        walls = jnp.asarray(self.walls)
        x, speed_x = advance(x, velocity[0], lambda edge, off: is_wall(walls, edge, y + off))
        y, speed_y = advance(y, velocity[1], lambda edge, off: is_wall(walls, x + off, edge))
        return jnp.stack([x - n_columns / 2, y - n_rows / 2]), jnp.stack([speed_x, speed_y])


def observe(state: State) -> dict[str, Array]:
    """Returns the observation."""
    observation = jnp.concatenate([state.position, state.velocity])
    return {"observation": observation, "achieved_goal": state.position, "desired_goal": state.goal}


def advance(coordinate: Array, speed: Array, is_blocked: Callable[[Array, float], Array]) -> tuple[Array, Array]:
    """Returns one coordinate and its speed after a step. The way is shorter than a cell.

    ``is_blocked`` tells whether the front edge is in a wall, given its coordinate and an offset across the motion.
    """
    side = jnp.sign(speed)
    edge = coordinate + TIME_STEP * speed + side * RADIUS
    blocked = is_blocked(edge, -RADIUS) | is_blocked(edge, RADIUS)
    surface = jnp.where(side > 0, jnp.floor(edge), jnp.ceil(edge))  # of the wall that the edge is in
    coordinate = jnp.where(blocked, surface - side * (RADIUS + MARGIN), coordinate + TIME_STEP * speed)
    return coordinate, jnp.where(blocked, 0.0, speed)


def is_wall(walls: Array, x: Array, y: Array) -> Array:
    """Returns whether the cell at x and y, in cells from the lower left corner, is a wall."""
    return walls[jnp.floor(y).astype(jnp.int32), jnp.floor(x).astype(jnp.int32)]
