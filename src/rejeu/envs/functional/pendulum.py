"""Pendulum in JAX: ``jax/Pendulum-v1``."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array

from rejeu.envs.functional.protocol import FunctionalEnv, time_is_up

MAX_SPEED, MAX_TORQUE, TIME_STEP = 8.0, 2.0, 0.05
"""In rad/s, N m and s."""
HIGH = np.array([1.0, 1.0, MAX_SPEED], np.float32)
"""Upper bounds of the observations."""
MASS, LENGTH = 1.0, 1.0
"""In kg and m."""


class State(NamedTuple):
    """Angle from the upright position, angular velocity, and the number of steps of the episode."""

    angle: Array
    """``float ()``."""
    velocity: Array
    """``float ()``."""
    time: Array
    """``int32 ()``."""


class Pendulum(FunctionalEnv):
    """A pendulum must be swung up and kept upright, as Gymnasium's ``Pendulum-v1``.

    The reward is ``-(angle^2 + 0.1 velocity^2 + 0.001 torque^2)`` of the state before the step.

    Args:
        g: acceleration of gravity, in m/s^2.
    """

    g: float = eqx.field(static=True, default=10.0)
    max_episode_steps: int | None = eqx.field(static=True, default=200)

    observation_space = spaces.Box(-HIGH, HIGH)
    action_space = spaces.Box(-MAX_TORQUE, MAX_TORQUE, (1,), np.float32)

    def reset(self, key: Array) -> tuple[State, Array]:
        angle, velocity = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
        state = State(jnp.pi * angle, velocity, jnp.zeros((), jnp.int32))
        return state, observe(state)

    def step(self, key: Array, state: State, action: Array) -> tuple[State, Array, Array, Array, Array]:
        torque = jnp.clip(action[0], -MAX_TORQUE, MAX_TORQUE)
        cost = wrapped(state.angle) ** 2 + 0.1 * state.velocity**2 + 0.001 * torque**2
        acceleration = 1.5 * self.g / LENGTH * jnp.sin(state.angle) + 3.0 / (MASS * LENGTH**2) * torque
        velocity = jnp.clip(state.velocity + TIME_STEP * acceleration, -MAX_SPEED, MAX_SPEED)
        after = State(state.angle + TIME_STEP * velocity, velocity, state.time + 1)
        never = jnp.zeros((), bool)
        return after, observe(after), -cost, never, time_is_up(after.time, self.max_episode_steps)


def observe(state: State) -> Array:
    """Returns cosine and sine of the angle, and the angular velocity, ``(3,)``."""
    return jnp.stack([jnp.cos(state.angle), jnp.sin(state.angle), state.velocity])


def wrapped(angle: Array) -> Array:
    """Returns the angle in [-pi, pi)."""
    return (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi
