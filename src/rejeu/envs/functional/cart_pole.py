"""CartPole in JAX: ``jax/CartPole-v1``."""

from __future__ import annotations

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array

from rejeu.envs.functional.protocol import FunctionalEnv, time_is_up

GRAVITY, FORCE, TIME_STEP = 9.8, 10.0, 0.02
"""In m/s^2, N and s."""
CART_MASS, POLE_MASS, HALF_LENGTH = 1.0, 0.1, 0.5
"""In kg and m."""
MAX_POSITION, MAX_ANGLE = 2.4, math.radians(12.0)
"""Limits beyond which the episode terminates, in m and rad."""
HIGH = np.array([2 * MAX_POSITION, np.inf, 2 * MAX_ANGLE, np.inf], np.float32)
"""Upper bounds of the observations."""
MAX_START = 0.05


class State(NamedTuple):
    """Position, velocity, angle, angular velocity, and the number of steps of the episode."""

    physics: Array
    """``float (4,)``."""
    time: Array
    """``int32 ()``."""


class CartPole(FunctionalEnv):
    """A pole on a cart must be balanced (Barto, Sutton and Anderson 1983), as Gymnasium's ``CartPole-v1``.

    The equations of motion are those of Florian 2007, "Correct equations for the dynamics of the cart-pole system", without
    friction, integrated with Euler steps.
    """

    max_episode_steps: int | None = eqx.field(static=True, default=500)

    observation_space = spaces.Box(-HIGH, HIGH)
    action_space = spaces.Discrete(2)

    def reset(self, key: Array) -> tuple[State, Array]:
        physics = jax.random.uniform(key, (4,), minval=-MAX_START, maxval=MAX_START)
        return State(physics, jnp.zeros((), jnp.int32)), physics

    def step(self, key: Array, state: State, action: Array) -> tuple[State, Array, Array, Array, Array]:
        physics = state.physics + TIME_STEP * derivative(state.physics, jnp.where(action == 1, FORCE, -FORCE))
        time = state.time + 1
        terminated = (jnp.abs(physics[0]) > MAX_POSITION) | (jnp.abs(physics[2]) > MAX_ANGLE)
        return State(physics, time), physics, jnp.ones(()), terminated, time_is_up(time, self.max_episode_steps)


def derivative(physics: Array, force: Array) -> Array:
    """Returns the derivative of position, velocity, angle and angular velocity with respect to time, ``(4,)``."""
    _, velocity, angle, angular_velocity = physics
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    mass = CART_MASS + POLE_MASS
    push = (force + POLE_MASS * HALF_LENGTH * angular_velocity**2 * sine) / mass
    inertia = HALF_LENGTH * (4.0 / 3.0 - POLE_MASS * cosine**2 / mass)
    angular_acceleration = (GRAVITY * sine - cosine * push) / inertia
    acceleration = push - POLE_MASS * HALF_LENGTH * angular_acceleration * cosine / mass
    return jnp.stack([velocity, acceleration, angular_velocity, angular_acceleration])
