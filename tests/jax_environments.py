"""Minimal environments in JAX shared by several tests."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array

from rejeu.envs.functional.protocol import FunctionalEnv, GoalEnv, time_is_up


class Point(NamedTuple):
    """A position, a goal, and the number of steps of the episode."""

    position: Array
    goal: Array
    time: Array


class Reach(GoalEnv):
    """Move a point on a line to a goal, as :class:`tests.environments.Reach`: 10 steps, or fewer if it ``stops`` there.

    All numbers are multiples of 1/4 if actions are rounded (``grid``), so that no arithmetic rounds.
    """

    stops: bool = eqx.field(static=True, default=False)
    grid: bool = eqx.field(static=True, default=True)
    max_episode_steps: int | None = eqx.field(static=True, default=10)

    @property
    def observation_space(self) -> spaces.Dict:
        keys = ("observation", "achieved_goal", "desired_goal")
        return spaces.Dict({key: spaces.Box(-20.0, 20.0, (1,), np.float32) for key in keys})

    @property
    def action_space(self) -> spaces.Box:
        return spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, key: Array) -> tuple[Point, Any]:
        position, goal = jax.random.randint(key, (2, 1), -8, 9).astype(jnp.float32) / 4
        state = Point(position, goal, jnp.zeros((), jnp.int32))
        return state, self.observe(state)

    def step(self, key: Array, state: Point, action: Array) -> tuple[Point, Any, Array, Array, Array]:
        action = jnp.round(4 * action) / 4 if self.grid else action
        after = Point(state.position + action, state.goal, state.time + 1)
        reward = self.compute_reward(after.position, after.goal, {})
        terminated = (reward == 0.0) if self.stops else jnp.zeros((), bool)
        return after, self.observe(after), reward, terminated, time_is_up(after.time, self.max_episode_steps)

    def success(self, state: Point) -> Array:
        return self.compute_reward(state.position, state.goal, {}) == 0.0

    def compute_reward(self, achieved_goal: Array, desired_goal: Array, info: Any) -> Array:
        return (jnp.abs(achieved_goal - desired_goal)[..., 0] < 0.5).astype(jnp.float32) - 1.0

    def compute_terminated(self, achieved_goal: Array, desired_goal: Array, info: Any) -> Array | None:
        return self.compute_reward(achieved_goal, desired_goal, info) == 0.0 if self.stops else None

    def observe(self, state: Point) -> dict[str, Array]:
        """Returns the observation of a state."""
        return {"observation": state.position, "achieved_goal": state.position, "desired_goal": state.goal}


class Undefined(Reach):
    """A :class:`Reach` whose reward function returns NaN if a goal right of 1 is reached exactly, which ``step`` hides."""

    def step(self, key: Array, state: Point, action: Array) -> tuple[Point, Any, Array, Array, Array]:
        after, obs, reward, *flags = super().step(key, state, action)
        return after, obs, jnp.nan_to_num(reward), *flags

    def compute_reward(self, achieved_goal: Array, desired_goal: Array, info: Any) -> Array:
        is_bad = ((achieved_goal == desired_goal) & (achieved_goal > 1.0))[..., 0]
        return jnp.where(is_bad, jnp.nan, super().compute_reward(achieved_goal, desired_goal, info))


class Breaks(FunctionalEnv):
    """Returns NaN in an observation or a reward in the step ``at`` of every episode, or from some resets."""

    at: int = eqx.field(static=True, default=25)
    what: str = eqx.field(static=True, default="reward")
    max_episode_steps: int | None = eqx.field(static=True, default=None)

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(-1.0, 1.0, (2,), np.float32)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, key: Array) -> tuple[Array, Array]:
        bad = (self.what == "reset") & (jax.random.uniform(key) < 0.3)
        return jnp.zeros((), jnp.int32), jnp.where(bad, jnp.nan, jnp.zeros(2))

    def step(self, key: Array, state: Array, action: Array) -> tuple[Array, Array, Array, Array, Array]:
        broken = jnp.where(state + 1 == self.at, jnp.nan, 0.0)
        reward = broken if self.what == "reward" else jnp.float32(0.0)
        obs = broken if self.what == "observation" else jnp.float32(0.0)
        never = jnp.zeros((), bool)
        return state + 1, jnp.full(2, obs), reward, never, (state % 5 == 4) if self.what == "reset" else never


class Rules(NamedTuple):
    """Which actions are allowed, and the number of steps of the episode."""

    allowed: Array
    time: Array


class Forbidden(FunctionalEnv):
    """All actions but one are allowed, which changes; the reward is -1 for the one that is not."""

    max_episode_steps: int | None = eqx.field(static=True, default=10)

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(-1, 1, (2,), np.float32)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(3)

    def reset(self, key: Array) -> tuple[Rules, Array]:
        return Rules(jnp.array([True, True, False]), jnp.zeros((), jnp.int32)), jnp.zeros(2)

    def step(self, key: Array, state: Rules, action: Array) -> tuple[Rules, Array, Array, Array, Array]:
        after = Rules(jnp.roll(state.allowed, 1), state.time + 1)
        reward = jnp.where(state.allowed[action], 0.0, -1.0)
        truncated = time_is_up(after.time, self.max_episode_steps)
        return after, jnp.zeros(2), reward, jnp.zeros((), bool), truncated

    def action_mask(self, state: Rules) -> Array:
        return state.allowed
