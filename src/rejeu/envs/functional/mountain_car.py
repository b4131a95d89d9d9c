"""MountainCar in JAX: ``jax/MountainCar-v0`` and ``jax/MountainCarContinuous-v0``."""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array

from rejeu.envs.functional.protocol import FunctionalEnv, time_is_up

MIN_POSITION, MAX_POSITION, MAX_SPEED = -1.2, 0.6, 0.07
GRAVITY = 0.0025


class State(NamedTuple):
    """Position, velocity, and the number of steps of the episode."""

    position: Array
    """``float ()``."""
    velocity: Array
    """``float ()``."""
    time: Array
    """``int32 ()``."""


class Hill(FunctionalEnv):
    """A car whose engine is too weak must reach the top of a hill (Moore 1990). Abstract."""

    goal_position: eqx.AbstractClassVar[float]
    """Position from which on the car is at the goal."""
    goal_velocity: float = eqx.field(static=True, default=0.0)
    """Velocity that the car must have at the goal."""

    observation_space = spaces.Box(*np.array([[MIN_POSITION, -MAX_SPEED], [MAX_POSITION, MAX_SPEED]], np.float32))

    def reset(self, key: Array) -> tuple[State, Array]:
        position = jax.random.uniform(key, minval=-0.6, maxval=-0.4)
        state = State(position, jnp.zeros(()), jnp.zeros((), jnp.int32))
        return state, observe(state)

    def success(self, state: State) -> Array:
        return (state.position >= self.goal_position) & (state.velocity >= self.goal_velocity)


class MountainCar(Hill):
    """A car must reach the top of a hill, as Gymnasium's ``MountainCar-v0``. The reward is -1 per step.

    Args:
        goal_velocity: velocity that the car must have at the goal.
    """

    goal_position: ClassVar[float] = 0.5
    max_episode_steps: int | None = eqx.field(static=True, default=200)

    action_space = spaces.Discrete(3)

    def step(self, key: Array, state: State, action: Array) -> tuple[State, Array, Array, Array, Array]:
        after = drive(state, 0.001 * (action - 1))
        truncated = time_is_up(after.time, self.max_episode_steps)
        return after, observe(after), -jnp.ones(()), self.success(after), truncated


class MountainCarContinuous(Hill):
    """MountainCar with continuous actions, as Gymnasium's ``MountainCarContinuous-v0``.

    The reward is 100 at the goal, minus a tenth of the squared action in every step.

    Args:
        goal_velocity: velocity that the car must have at the goal.
    """

    goal_position: ClassVar[float] = 0.45
    max_episode_steps: int | None = eqx.field(static=True, default=999)

    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def step(self, key: Array, state: State, action: Array) -> tuple[State, Array, Array, Array, Array]:
        after = drive(state, 0.0015 * jnp.clip(action[0], -1.0, 1.0))
        terminated = self.success(after)
        reward = jnp.where(terminated, 100.0, 0.0) - 0.1 * action[0] ** 2
        return after, observe(after), reward, terminated, time_is_up(after.time, self.max_episode_steps)


def observe(state: State) -> Array:
    """Returns position and velocity, ``(2,)``."""
    return jnp.stack([state.position, state.velocity])


def drive(state: State, acceleration: Array) -> State:
    """Returns the state after a step. The car stops at the left end."""
    velocity = state.velocity + acceleration - GRAVITY * jnp.cos(3 * state.position)
    velocity = jnp.clip(velocity, -MAX_SPEED, MAX_SPEED)
    position = jnp.clip(state.position + velocity, MIN_POSITION, MAX_POSITION)
    velocity = jnp.where((position == MIN_POSITION) & (velocity < 0), 0.0, velocity)
    return State(position, velocity, state.time + 1)
