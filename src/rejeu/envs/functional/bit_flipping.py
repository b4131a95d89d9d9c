"""Bit flipping in JAX: ``jax/BitFlipping-v0``."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.core.validation import whole
from rejeu.envs.functional.protocol import GoalEnv, time_is_up


class State(NamedTuple):
    """The bits, those of the goal, and the number of steps of the episode."""

    bits: Array
    """``int8 (n_bits,)``."""
    goal: Array
    """``int8 (n_bits,)``."""
    time: Array
    """``int32 ()``."""


class BitFlipping(GoalEnv):
    """Bits must be made equal to a goal, one at a time (Andrychowicz et al. 2017, arXiv 1707.01495, section 3.1).

    Bits and goal are uniformly random at every reset, and action ``i`` flips bit ``i``. The reward is 0 and the episode
    terminates if the bits equal the goal; otherwise the reward is -1. Without hindsight, no algorithm that explores randomly
    solves it with more than about 15 bits.

    Args:
        n_bits: number of bits.
        max_episode_steps: the time limit; None for ``n_bits``.

    Raises:
        ValueError: if ``n_bits`` is no positive whole number.
    """

    n_bits: int = eqx.field(static=True)
    max_episode_steps: int | None = eqx.field(static=True)

    def __init__(self, n_bits: int = 10, max_episode_steps: int | None = None) -> None:
        self.n_bits = whole("n_bits", n_bits, least=1)
        self.max_episode_steps = n_bits if max_episode_steps is None else max_episode_steps

    @property
    def observation_space(self) -> spaces.Dict:
        keys = ("observation", "achieved_goal", "desired_goal")
        return spaces.Dict({key: spaces.MultiBinary(self.n_bits) for key in keys})

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(self.n_bits)

    def reset(self, key: Array) -> tuple[State, dict[str, Array]]:
        bits, goal = jax.random.bernoulli(key, shape=(2, self.n_bits)).astype(jnp.int8)
        state = State(bits, goal, jnp.zeros((), jnp.int32))
        return state, observe(state)

    def step(self, key: Array, state: State, action: Array) -> tuple[State, dict[str, Array], Array, Array, Array]:
        flipped = jnp.arange(self.n_bits) == action
        after = State(state.bits ^ flipped.astype(jnp.int8), state.goal, state.time + 1)
        reward = self.compute_reward(after.bits, after.goal)
        truncated = time_is_up(after.time, self.max_episode_steps)
        return after, observe(after), reward, self.success(after), truncated

    def compute_reward(self, achieved_goal: Array, desired_goal: Array, info: object = None) -> Array:
        return self.compute_terminated(achieved_goal, desired_goal).astype(float) - 1.0

    def compute_terminated(self, achieved_goal: Array, desired_goal: Array, info: object = None) -> Array:
        return (achieved_goal == desired_goal).all(axis=-1)

    def success(self, state: State) -> Array:
        return self.compute_terminated(state.bits, state.goal)


def observe(state: State) -> dict[str, Array]:
    """Returns the observation: the bits, which are also the achieved goal, and the goal."""
    return {"observation": state.bits, "achieved_goal": state.bits, "desired_goal": state.goal}
