"""The ball in JAX: ``jax/Ball-v0``."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array

from rejeu.core.validation import number, whole
from rejeu.envs.functional.ball_drawing import HELD_REWARD, LOST_REWARD, MAX_PUSH, WALL
from rejeu.envs.functional.protocol import FunctionalEnv


class State(NamedTuple):
    """The position, not clipped to the box, and the number of steps of the episode."""

    position: Array
    """``float (dimension,)``."""
    time: Array
    """``int32 ()``."""


class Ball(FunctionalEnv):
    """A ball moves randomly, and the agent pushes it to keep it inside a box, as in ``rejeu/Ball-v0``.

    Args:
        dimension: number of dimensions of the box.
        sigma: standard deviation of the random displacement in each dimension, per step.
        max_episode_steps: the step at which a ball that is still inside gets the reward 50.

    Raises:
        ValueError: for a dimension below 1, or a negative or infinite ``sigma``.
    """

    dimension: int = eqx.field(static=True, default=2)
    sigma: float = eqx.field(static=True, default=1.0)
    max_episode_steps: int | None = eqx.field(static=True, default=500)

    def __check_init__(self) -> None:
        whole("dimension", self.dimension, least=1)
        number("sigma", self.sigma, least=0)

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(-WALL, WALL, (self.dimension,), np.float32)

    @property
    def action_space(self) -> spaces.Box:
        return spaces.Box(-MAX_PUSH, MAX_PUSH, (self.dimension,), np.float32)

    def reset(self, key: Array) -> tuple[State, Array]:
        position = jax.random.uniform(key, (self.dimension,), minval=-MAX_PUSH, maxval=MAX_PUSH)
        return State(position, jnp.zeros((), jnp.int32)), position

    def step(self, key: Array, state: State, action: Array) -> tuple[State, Array, Array, Array, Array]:
        kick = self.sigma * jax.random.normal(key, (self.dimension,))
        after = State(state.position + jnp.clip(action, -MAX_PUSH, MAX_PUSH) + kick, state.time + 1)
        lost, held = ~is_inside(after), self.success(after)
        reward = jnp.where(lost, LOST_REWARD, jnp.where(held, HELD_REWARD, 1.0))
        return after, jnp.clip(after.position, -WALL, WALL), reward, lost, held

    def success(self, state: State) -> Array:
        """Returns whether the ball is inside at the time limit."""
        in_time = jnp.zeros((), bool) if self.max_episode_steps is None else state.time >= self.max_episode_steps
        return is_inside(state) & in_time


def is_inside(state: State) -> Array:
    """Returns whether the ball is inside the box, ``bool ()``."""
    return (jnp.abs(state.position) <= WALL).all()
