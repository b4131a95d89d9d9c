"""Acrobot in JAX: ``jax/Acrobot-v1``."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array

from rejeu.envs.functional.protocol import FunctionalEnv, time_is_up

LENGTH, CENTER, MASS, INERTIA = 1.0, 0.5, 1.0, 1.0
"""Of both links: length and distance of the center of mass from the joint in m, mass in kg, moment of inertia in kg m^2."""
GRAVITY, TIME_STEP = 9.8, 0.2
"""In m/s^2 and s."""
MAX_SPEEDS = 4 * np.pi, 9 * np.pi
HIGH = np.array([1.0, 1.0, 1.0, 1.0, *MAX_SPEEDS], np.float32)
"""Upper bounds of the observations."""
"""Of the two joints, in rad/s."""


class State(NamedTuple):
    """Angles of the joints, their velocities, and the number of steps of the episode."""

    physics: Array
    """Angle of the first link from hanging down, angle of the second from the first, their velocities; ``float (4,)``."""
    time: Array
    """``int32 ()``."""


class Acrobot(FunctionalEnv):
    """The free end of two links must be swung above a height by a torque at their joint, as Gymnasium's ``Acrobot-v1``.

    The equations of motion are those of Sutton and Barto 2018, integrated by one Runge-Kutta step of fourth order. The
    reward is -1 per step, and 0 at the goal.
    """

    max_episode_steps: int | None = eqx.field(static=True, default=500)

    observation_space = spaces.Box(-HIGH, HIGH)
    action_space = spaces.Discrete(3)

    def reset(self, key: Array) -> tuple[State, Array]:
        physics = jax.random.uniform(key, (4,), minval=-0.1, maxval=0.1)
        return State(physics, jnp.zeros((), jnp.int32)), observe(physics)

    def step(self, key: Array, state: State, action: Array) -> tuple[State, Array, Array, Array, Array]:
        physics = runge_kutta(state.physics, action - 1.0)
        angles = (physics[:2] + jnp.pi) % (2 * jnp.pi) - jnp.pi
        limits = jnp.asarray(MAX_SPEEDS, physics.dtype)
        physics = jnp.concatenate([angles, jnp.clip(physics[2:], -limits, limits)])
        after = State(physics, state.time + 1)
        terminated = self.success(after)
        reward = jnp.where(terminated, 0.0, -1.0)
        return after, observe(physics), reward, terminated, time_is_up(after.time, self.max_episode_steps)

    def success(self, state: State) -> Array:
        first, second, *_ = state.physics
        return -jnp.cos(first) - jnp.cos(first + second) > 1.0


def observe(physics: Array) -> Array:
    """Returns cosine and sine of both angles, and the velocities, ``(6,)``."""
    first, second, *velocities = physics
    return jnp.stack([jnp.cos(first), jnp.sin(first), jnp.cos(second), jnp.sin(second), *velocities])


def runge_kutta(physics: Array, torque: Array) -> Array:
    """Returns angles and velocities after one time step, ``(4,)``."""
    first = derivative(physics, torque)
    second = derivative(physics + 0.5 * TIME_STEP * first, torque)
    third = derivative(physics + 0.5 * TIME_STEP * second, torque)
    fourth = derivative(physics + TIME_STEP * third, torque)
    return physics + TIME_STEP / 6.0 * (first + 2 * second + 2 * third + fourth)


def derivative(physics: Array, torque: Array) -> Array:
    """Returns the derivative of angles and velocities with respect to time, ``(4,)``.

    ``a11``, ``a12`` and ``a22`` are the mass matrix; ``force1`` and ``force2`` are the centrifugal, Coriolis and gravity terms
    of the two joints.
    """
    angle1, angle2, velocity1, velocity2 = physics
    a22 = MASS * CENTER**2 + INERTIA
    a12 = MASS * (CENTER**2 + LENGTH * CENTER * jnp.cos(angle2)) + INERTIA
    a11 = MASS * (CENTER**2 + LENGTH**2 + CENTER**2 + 2 * LENGTH * CENTER * jnp.cos(angle2)) + 2 * INERTIA
    swing = MASS * LENGTH * CENTER * jnp.sin(angle2)
    gravity2 = MASS * CENTER * GRAVITY * jnp.sin(angle1 + angle2)
    gravity1 = (MASS * CENTER + MASS * LENGTH) * GRAVITY * jnp.sin(angle1) + gravity2
    force1 = -swing * velocity2**2 - 2 * swing * velocity1 * velocity2 + gravity1
    force2 = swing * velocity1**2 + gravity2
    acceleration2 = (torque - force2 + a12 / a11 * force1) / (a22 - a12**2 / a11)
    acceleration1 = -(a12 * acceleration2 + force1) / a11
    return jnp.stack([velocity1, velocity2, acceleration1, acceleration2])
