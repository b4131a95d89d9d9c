"""highway-env's ``parking-v0`` in JAX: ``jax/Parking-v0``.

The kinematics, walls, collisions, rewards and limits are those of highway-env 1.12 with the default configuration:
``KinematicsGoal`` observations with the scales 100, 100, 5, 5, 1, 1, 5 decisions and 15 steps of simulation per second,
walls, no other vehicles, and 100 s of time, which are 500 steps.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array

from rejeu.core.spaces import GOAL_KEYS
from rejeu.envs.functional.protocol import GoalEnv, time_is_up
from rejeu.envs.goals import PARKED, PARKING_WEIGHTS

LENGTH, WIDTH = 5.0, 2.0
"""Of the vehicle, in m."""
MAX_SPEED, MAX_ACCELERATION, MAX_STEERING = 40.0, 5.0, np.pi / 4
"""In m/s, m/s^2 and rad."""
N_FRAMES, TIME_STEP = 3, 1.0 / 15.0
"""Steps of simulation in a step of the environment, and the length of one in s."""
SCALES = np.array([100.0, 100.0, 5.0, 5.0, 1.0, 1.0])
"""Divisors of x, y, vx, vy, cos h and sin h in observations."""
COLLISION_REWARD = -5.0
"""The reward that is added in a collision."""

N_COLUMNS = 14
"""Parking spots in each of the two rows."""
SPOT_WIDTH, ROW_DISTANCE = 4.0, 14.0
"""Width of a spot, and distance of a row from the middle of the lot, in m."""
LEFT_OF_START = 6
"""The spot at x = -2. In the row toward which the vehicle is headed at the start, highway-env excludes it as a goal."""

WALL_CENTERS = np.array([[0.0, -21.0], [0.0, 21.0], [-35.0, 0.0], [35.0, 0.0]])
WALL_HALF_SIZES = np.array([[35.0, 0.5], [35.0, 0.5], [0.5, 21.0], [0.5, 21.0]])
"""Half of the extents of the walls in x and y."""
WALL_REACH = np.array([np.hypot(*size) for size in WALL_HALF_SIZES]) + 0.5 * np.hypot(LENGTH, WIDTH)
"""Distances between the centers of wall and vehicle beyond which they cannot touch."""


class State(NamedTuple):
    """The vehicle, its goal, and the number of steps of the episode."""

    position: Array
    """``float (2,)``, in m."""
    heading: Array
    """``float ()``, in rad."""
    speed: Array
    """``float ()``, in m/s; negative backwards."""
    crashed: Array
    """Whether the vehicle has hit a wall, ``bool ()``."""
    impact: Array
    """Displacement by a collision that the next frame applies, ``float (2,)``."""
    has_impact: Array
    """Whether there is one, ``bool ()``."""
    goal: Array
    """Index of the goal: the row at y = 14 from left to right, then the row at y = -14, ``int32 ()``."""
    time: Array
    """``int32 ()``."""


class Parking(GoalEnv):
    """A vehicle must park in a given spot of a walled lot, as in highway-env's ``parking-v0``.

    Actions are acceleration and steering in [-1, 1]. The reward is ``-sqrt(w . |achieved - desired|)``, minus 5 in a
    collision. The episode terminates at the goal (reward above -0.12) and in a collision, which :meth:`compute_reward` and
    :meth:`compute_terminated` do not contain.

    In double precision a step differs from highway-env 1.12.1 by rounding only.
    """

    max_episode_steps: int | None = eqx.field(static=True, default=500)

    observation_space = spaces.Dict({key: spaces.Box(-np.inf, np.inf, (6,), np.float32) for key in GOAL_KEYS})
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, key: Array) -> tuple[State, dict[str, Array]]:
        heading_key, goal_key = jax.random.split(key)
        heading = jax.random.uniform(heading_key, maxval=2 * np.pi)
        excluded = LEFT_OF_START + jnp.where(jnp.sin(heading) > 0, 0, N_COLUMNS)
        goal = jax.random.randint(goal_key, (), 0, 2 * N_COLUMNS - 1, dtype=jnp.int32)
        goal = goal + (goal >= excluded)
        no, zero = jnp.zeros((), bool), jnp.zeros(())
        state = State(jnp.zeros(2), heading, zero, no, jnp.zeros(2), no, goal, jnp.zeros((), jnp.int32))
        return state, observe(state)

    def step(self, key: Array, state: State, action: Array) -> tuple[State, dict[str, Array], Array, Array, Array]:
        action = jnp.clip(action, -1.0, 1.0)
        acceleration, steering = MAX_ACCELERATION * action[0], MAX_STEERING * action[1]
        for _ in range(N_FRAMES):
            state, acceleration, steering = drive(state, acceleration, steering)
        state = state._replace(time=state.time + 1)
        obs = observe(state)
        closeness = self.compute_reward(obs["achieved_goal"], obs["desired_goal"])
        reward = closeness + jnp.where(state.crashed, COLLISION_REWARD, 0.0)
        terminated = state.crashed | (closeness > PARKED)
        return state, obs, reward, terminated, time_is_up(state.time, self.max_episode_steps)

    def compute_reward(self, achieved_goal: Array, desired_goal: Array, info: object = None) -> Array:
        difference = jnp.abs(achieved_goal - desired_goal)
        return -jnp.sqrt(difference @ jnp.asarray(PARKING_WEIGHTS, difference.dtype))

    def compute_terminated(self, achieved_goal: Array, desired_goal: Array, info: object = None) -> Array:
        return self.compute_reward(achieved_goal, desired_goal) > PARKED

    def success(self, state: State) -> Array:
        obs = observe(state)
        return self.compute_terminated(obs["achieved_goal"], obs["desired_goal"])


def observe(state: State) -> dict[str, Array]:
    """Returns the observation; achieved and desired goal are x, y, vx, vy, cos h and sin h, scaled."""
    direction = jnp.stack([jnp.cos(state.heading), jnp.sin(state.heading)])
    scales = jnp.asarray(SCALES, state.position.dtype)
    achieved = jnp.concatenate([state.position, state.speed * direction, direction]) / scales
    x, side = spot(state.goal)
    zero = jnp.zeros_like(x)
    desired = jnp.stack([x, ROW_DISTANCE * side, zero, zero, zero, side]) / scales
    return {"observation": achieved, "achieved_goal": achieved, "desired_goal": desired}


def spot(goal: Array) -> tuple[Array, Array]:
    """Returns x of a parking spot in m, and its row: 1 at y = 14 with heading pi / 2, -1 at y = -14 with -pi / 2."""
    x = SPOT_WIDTH * (goal % N_COLUMNS - 0.5 * (N_COLUMNS - 1))
    return x, jnp.where(goal < N_COLUMNS, 1.0, -1.0)


def drive(state: State, acceleration: Array, steering: Array) -> tuple[State, Array, Array]:
    """Returns the state after one frame, with the acceleration and steering that the next frame starts from.

    The kinematics are those of a bicycle whose center is halfway between its axles. A crashed vehicle brakes.
    """
    speed = state.speed
    steering = jnp.where(state.crashed, 0.0, steering)
    acceleration = jnp.where(state.crashed, -speed, acceleration)
    acceleration = jnp.where(speed > MAX_SPEED, jnp.minimum(acceleration, MAX_SPEED - speed), acceleration)
    acceleration = jnp.where(speed < -MAX_SPEED, jnp.maximum(acceleration, -MAX_SPEED - speed), acceleration)
    slip = jnp.arctan(0.5 * jnp.tan(steering))
    course = state.heading + slip
    position = state.position + speed * TIME_STEP * jnp.stack([jnp.cos(course), jnp.sin(course)])
    position = position + jnp.where(state.has_impact, state.impact, 0.0)
    heading = state.heading + speed * jnp.sin(slip) / (LENGTH / 2) * TIME_STEP
    moved = state._replace(position=position, heading=heading, speed=speed + acceleration * TIME_STEP)
    touching, will_touch, impact = collide(moved)
    return (
        moved._replace(
            crashed=state.crashed | state.has_impact | touching.any(),
            impact=impact,
            has_impact=will_touch.any(),
        ),
        acceleration,
        steering,
    )


def collide(state: State) -> tuple[Array, Array, Array]:
    """Returns which walls the vehicle touches, which it touches in the next frame at this velocity, and the impact.

    Two rectangles are apart if their projections on one of the four directions of their sides are (separating axis
    theorem). The impact is the shortest displacement along such a direction that separates them, ``float (2,)``; with
    several walls, that of the last. Shapes of the others: ``bool (4,)``.
    """
    measures = WALL_CENTERS, WALL_HALF_SIZES, WALL_REACH
    centers, half_sizes, reach = (jnp.asarray(a, state.position.dtype) for a in measures)
    forward = jnp.stack([jnp.cos(state.heading), jnp.sin(state.heading)])
    sideways = jnp.stack([-forward[1], forward[0]])
    axes = jnp.stack([forward, sideways, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])])  # (4, 2)

    apart = state.position[None] - centers  # (n_walls, 2)
    middle = project(apart, axes)  # of the vehicle's center, from those of the walls'; (n_walls, 4)
    course, width = project(forward[None], axes), project(sideways[None], axes)
    vehicle = 0.5 * LENGTH * jnp.abs(course) + 0.5 * WIDTH * jnp.abs(width)
    wall = project(half_sizes, jnp.abs(axes))
    low, high = middle - vehicle, middle + vehicle
    touching = (gap(low, high, wall) <= 0).all(axis=1)

    motion = state.speed * TIME_STEP * course
    low, high = low + jnp.minimum(motion, 0.0), high + jnp.maximum(motion, 0.0)
    will_touch = (gap(low, high, wall) <= 0).all(axis=1)
    depth = jnp.minimum(jnp.abs(gap(low, high, wall)), jnp.abs(gap(-high, -low, wall)))
    axis = jnp.arange(len(axes))[None] == depth.argmin(axis=1, keepdims=True)  # the first of the least, (n_walls, 4)
    away = jnp.where(axis, jnp.where(middle > 0, depth, -depth), 0.0)
    impact = (away[:, :, None] * axes[None]).sum(axis=1)

    near = jnp.hypot(apart[:, 0], apart[:, 1]) <= reach + state.speed * TIME_STEP
    touching, will_touch = touching & near, will_touch & near
    walls = jnp.arange(len(centers))
    last = walls == jnp.where(will_touch, walls, -1).max()
    return touching, will_touch, jnp.where(last[:, None], impact, 0.0).sum(axis=0)


def project(vectors: Array, axes: Array) -> Array:
    """Returns the scalar products of vectors ``(n, 2)`` and axes ``(m, 2)``, ``(n, m)``.

    XLA fuses this with its surroundings. A batch of small matrix products takes several times as long on a CPU.
    """
    return vectors[:, :1] * axes[None, :, 0] + vectors[:, 1:] * axes[None, :, 1]


def gap(low: Array, high: Array, half: Array) -> Array:
    """Returns the distance between the intervals [low, high] and [-half, half], negative where they overlap."""
    return jnp.where(low < -half, -half - high, low - half)
