"""Environments of gymnax (1.0 or later) and of Brax's interface as :class:`FunctionalEnv`. Neither package is imported.

Their environments may keep a key in their state. They are given keys as arrays of numbers, which can be saved.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array

from rejeu.core.spaces import leaves
from rejeu.core.types import Observation, PyTree
from rejeu.envs.functional.protocol import FunctionalEnv, time_is_up
from rejeu.envs.wrappers import to_space


def from_gymnax(env: Any, params: PyTree = None) -> GymnaxEnv:
    """Returns an environment of gymnax without its automatic resets.

    The time limit is ``params.max_steps_in_episode``. gymnax 1.0 separates it from terminations; before, they were one flag.

    Args:
        env: an environment, such as the first value of ``gymnax.make("Breakout-MinAtar")``.
        params: its parameters; None for ``env.default_params``.

    Raises:
        ValueError: if it is of an older gymnax.
    """
    if not callable(getattr(env, "is_truncated", None)):
        raise ValueError(
            f"{type(env).__name__} does not tell time limits from terminations (is_truncated is missing); "
            "use an environment of gymnax 1.0 or later"
        )
    params = env.default_params if params is None else params
    limit = getattr(params, "max_steps_in_episode", None)
    return GymnaxEnv(env=env, params=params, max_episode_steps=None if limit is None else int(limit))


class GymnaxEnv(FunctionalEnv):
    """An environment of gymnax; see :func:`from_gymnax`."""

    env: Any = eqx.field(static=True)
    params: PyTree
    max_episode_steps: int | None = eqx.field(static=True)

    @property
    def observation_space(self) -> gym.Space:
        with jax.ensure_compile_time_eval():  # gymnax computes bounds with JAX
            return converted(self.env.observation_space(self.params))

    @property
    def action_space(self) -> gym.Space:
        with jax.ensure_compile_time_eval():
            return converted(self.env.action_space(self.params))

    def reset(self, key: Array) -> tuple[PyTree, PyTree]:
        obs, state = self.env.reset_env(jax.random.key_data(key), self.params)
        return strong(state), self._cast(obs)

    def step(self, key: Array, state: PyTree, action: Array) -> tuple[PyTree, PyTree, Array, Array, Array]:
        obs, state, reward, terminated, _ = self.env.step_env(jax.random.key_data(key), state, action, self.params)
        obs = self._cast(obs)
        truncated = jnp.asarray(self.env.is_truncated(state, self.params), bool)
        return strong(state), obs, jnp.asarray(reward, float), jnp.asarray(terminated, bool), truncated

    def _cast(self, obs: Observation) -> Observation:
        """Returns an observation with the dtypes of the space, where gymnax is less strict."""
        arrays, tree = jax.tree.flatten(obs)
        dtypes = [leaf.dtype for leaf in leaves(self.observation_space)]
        return jax.tree.unflatten(tree, [jnp.asarray(a, dtype) for a, dtype in zip(arrays, dtypes, strict=True)])


def converted(space: object) -> gym.Space:
    """Returns a space of gymnax as one of Gymnasium."""
    if isinstance(space, gym.Space):
        return space
    parts = getattr(space, "spaces", None)
    if parts is not None:
        if isinstance(parts, dict):
            return spaces.Dict({key: converted(subspace) for key, subspace in parts.items()})
        return spaces.Tuple([converted(subspace) for subspace in parts])
    return to_space(space)


class BraxState(NamedTuple):
    """A state of Brax, and the number of steps of the episode."""

    inner: Any
    """With the fields ``obs``, ``reward``, ``done`` and ``info``."""
    time: Array
    """``int32 ()``."""


def from_brax(env: Any, max_episode_steps: int | None = 1000) -> BraxEnv:
    """Returns an environment with Brax's interface: ``reset(key)``, ``step(state, action)`` and ``action_size``.

    The environment must be without Brax's wrappers for training: no automatic resets, no batches. The actions are in [-1, 1].

    Args:
        env: an environment of Brax, or of another package with its interface.
        max_episode_steps: the time limit, None for none.
    """
    obs = jax.eval_shape(env.reset, jax.ShapeDtypeStruct((2,), np.uint32)).obs
    shapes = {key: array.shape for key, array in obs.items()} if isinstance(obs, dict) else {"": obs.shape}
    return BraxEnv(env=env, shapes=tuple(sorted(shapes.items())), max_episode_steps=max_episode_steps)


class BraxEnv(FunctionalEnv):
    """An environment with Brax's interface; see :func:`from_brax`."""

    env: Any = eqx.field(static=True)
    shapes: tuple[tuple[str, tuple[int, ...]], ...] = eqx.field(static=True)
    """Name and shape of each array of an observation; an empty name if there is one without a name."""
    max_episode_steps: int | None = eqx.field(static=True)

    @property
    def observation_space(self) -> gym.Space:
        boxes = {key: spaces.Box(-np.inf, np.inf, shape) for key, shape in self.shapes}
        return boxes[""] if "" in boxes else spaces.Dict(boxes)  # type: ignore[arg-type]

    @property
    def action_space(self) -> spaces.Box:
        return spaces.Box(-1.0, 1.0, (self.env.action_size,))

    def reset(self, key: Array) -> tuple[BraxState, PyTree]:
        inner = strong(self.env.reset(jax.random.key_data(key)))
        return BraxState(inner, jnp.zeros((), jnp.int32)), inner.obs

    def step(self, key: Array, state: BraxState, action: Array) -> tuple[BraxState, PyTree, Array, Array, Array]:
        inner = strong(self.env.step(state.inner, action))
        after = BraxState(inner, state.time + 1)
        done = inner.done > 0
        truncated = time_is_up(after.time, self.max_episode_steps)
        if "truncation" in inner.info:  # a time limit of the environment itself, which is a part of ``done``
            limit = inner.info["truncation"] > 0
            done, truncated = done & ~limit, truncated | limit
        return after, inner.obs, jnp.asarray(inner.reward, float), done, truncated


def strong(tree: PyTree) -> Any:
    """Returns a tree whose arrays have fixed dtypes: Python numbers have others in the first step than in later ones."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.asarray(leaf).dtype), tree)
