"""MountainCar in JAX: ``jax/MountainCar-v0`` and ``jax/MountainCarContinuous-v0``."""

from __future__ import annotations

from typing import NamedTuple

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


class MountainCar(FunctionalEnv):
    """A car whose engine is too weak must reach the top of a hill (Moore 1990), as Gymnasium's ``MountainCar-v0``.

    The reward is -1 per step.

    Args:
        goal_velocity: velocity that the car must have at the goal.
    """

    goal_velocity: float = eqx.field(static=True, default=0.0)
    max_episode_steps: int | None = eqx.field(static=True, default=200)

    @property
    def observation_space(self) -> spaces.Box:
        return observation_space()

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(3)

    def reset(self, key: Array) -> tuple[State, Array]:
        return start(key)

    def step(self, key: Array, state: State, action: Array) -> tuple[State, Array, Array, Array, Array]:
        after = drive(state, 0.001 * (action - 1))
        terminated = (after.position >= 0.5) & (after.velocity >= self.goal_velocity)
        return after, observe(after), -jnp.ones(()), terminated, time_is_up(after.time, self.max_episode_steps)

    def success(self, state: State) -> Array:
        return (state.position >= 0.5) & (state.velocity >= self.goal_velocity)


class MountainCarContinuous(FunctionalEnv):
    """MountainCar with continuous actions, as Gymnasium's ``MountainCarContinuous-v0``.

    The reward is 100 at the goal, minus a tenth of the squared action in every step.

    Args:
        goal_velocity: velocity that the car must have at the goal.
    """

    goal_velocity: float = eqx.field(static=True, default=0.0)
    max_episode_steps: int | None = eqx.field(static=True, default=999)

    @property
    def observation_space(self) -> spaces.Box:
        return observation_space()

    @property
    def action_space(self) -> spaces.Box:
        return spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, key: Array) -> tuple[State, Array]:
        return start(key)

    def step(self, key: Array, state: State, action: Array) -> tuple[State, Array, Array, Array, Array]:
        after = drive(state, 0.0015 * jnp.clip(action[0], -1.0, 1.0))
        terminated = (after.position >= 0.45) & (after.velocity >= self.goal_velocity)
        reward = jnp.where(terminated, 100.0, 0.0) - 0.1 * action[0] ** 2
        return after, observe(after), reward, terminated, time_is_up(after.time, self.max_episode_steps)

    def success(self, state: State) -> Array:
        return (state.position >= 0.45) & (state.velocity >= self.goal_velocity)


def observation_space() -> spaces.Box:
    """Returns the space of position and velocity."""
    low, high = [MIN_POSITION, -MAX_SPEED], [MAX_POSITION, MAX_SPEED]
    return spaces.Box(np.array(low, np.float32), np.array(high, np.float32))


def start(key: Array) -> tuple[State, Array]:
    """Returns the state and the observation at the start of an episode."""
    position = jax.random.uniform(key, minval=-0.6, maxval=-0.4)
    state = State(position, jnp.zeros(()), jnp.zeros((), jnp.int32))
    return state, observe(state)


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
