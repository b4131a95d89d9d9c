"""What a turn of every loop on the device does: the environments step, episodes are counted, new ones begin."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import jax
import jax.numpy as jnp
from jax import Array

from rejeu import spaces
from rejeu.core import PyTree
from rejeu.envs.functional.protocol import FunctionalEnv
from rejeu.envs.functional.vector import VectorState, reset_done, step_all
from rejeu.loops.device.actions import scale

NO_LIMIT = 2**32 - 1
"""Stands for no last step; steps are counted in ``uint32``."""


class Limits(NamedTuple):
    """What a chunk is asked to do."""

    n_turns: Any
    """Turns to take, ``int32[]``."""
    last: Any
    """Total environment steps at which training ends, ``uint32[]``, ``NO_LIMIT`` for never."""
    progress: Any
    """Progress of schedules after 0, 1, ... turns of the chunk, ``float32 (capacity + 1,)``."""
    most_updates: Any
    """Gradient steps of a turn at most, ``int32[]``; used to find the one that left NaN."""


class Log(NamedTuple):
    """The episodes that ended in a chunk, by turn and environment, ``(capacity, n_envs)``."""

    length: Array
    """Their steps, ``int32``; 0 where none ended."""
    value: Array
    """Their returns, ``float32``, where one ended."""
    success: Array
    """1 or 0 where one ended, NaN if the environment does not say, ``float32``."""


class Players(NamedTuple):
    """The environments and their running episodes."""

    env: VectorState | None
    """None where the other fields are on the host."""
    obs: PyTree
    """The current observations, in the dtypes of the agent's leaves."""
    ended: Array
    """Where the last turn ended an episode, ``bool (n_envs,)``."""
    value: Array
    """Sum of the rewards of the running episode, ``float32 (n_envs,)``."""
    length: Array
    """Its steps, ``int32 (n_envs,)``."""
    running_return: Array
    """The discounted sum of its rewards, ``float32 (n_envs,)``."""
    episode: Array
    """Episodes finished, ``uint32[]``."""
    bad: Array
    """Whether a reward or an observation was not finite in this chunk, ``bool[]``."""
    log: Log


class Outcome(NamedTuple):
    """The result of one step of all environments."""

    obs: PyTree
    """True successors."""
    reward: Array
    """``float32 (n_envs,)``."""
    terminated: Array
    truncated: Array
    kept: Array
    """Which of the steps count, ``bool (n_envs,)``; all but in the last turn."""


def plain(space: gym.Space, obs: PyTree) -> PyTree:
    """Returns a batch of observations in the structure and dtypes in which agents see them."""
    leaves = spaces.leaves(space)
    parts = [jnp.asarray(x).astype(leaf.dtype) for x, leaf in zip(jax.tree.leaves(obs), leaves, strict=True)]
    return jax.tree.unflatten(spaces.structure(space), parts)


def empty_log(capacity: int, n_envs: int) -> Log:
    """Returns a log without episodes."""
    shape = (capacity, n_envs)
    return Log(jnp.zeros(shape, jnp.int32), jnp.zeros(shape, jnp.float32), jnp.zeros(shape, jnp.float32))


def kept_steps(step: Array, last: Array, n_envs: int) -> Array:
    """Returns which environments' steps count in a turn that begins at ``step``, ``bool (n_envs,)``."""
    return jnp.arange(n_envs, dtype=jnp.uint32) < jnp.minimum(last - step, jnp.uint32(n_envs))


def play(
    env: FunctionalEnv, players: Players, action: Array, kept: Array, gamma: float, turn: Array
) -> tuple[Players, Outcome]:
    """Takes one step of all environments and starts new episodes where some ended.

    Args:
        env: the environment.
        players: before the step.
        action: in the range of algorithms, ``(n_envs, ...)``.
        kept: which steps count; the episodes of the other environments are discarded.
        gamma: the discount factor of ``running_return``.
        turn: its number in the chunk, ``int32[]``.
    """
    assert players.env is not None
    vstate, obs, reward, terminated, truncated, success = step_all(env, players.env, scale(env.action_space, action))
    obs, reward = plain(env.observation_space, obs), reward.astype(jnp.float32)
    value = players.value + jnp.where(kept, reward, 0.0)
    length = players.length + kept
    over = terminated | truncated
    ended = over | ~kept
    counts = over & kept
    log = Log(
        players.log.length.at[turn].set(jnp.where(counts, length, 0)),
        players.log.value.at[turn].set(value),
        players.log.success.at[turn].set(
            jnp.full_like(value, jnp.nan) if success is None else success.astype(jnp.float32)
        ),
    )
    vstate, fresh = reset_done(env, vstate, ended)
    fresh = plain(env.observation_space, fresh)
    bad = players.bad | ~all_finite(reward) | ~all_finite(*jax.tree.leaves(obs)) | ~all_finite(*jax.tree.leaves(fresh))
    after = Players(
        vstate,
        fresh,
        ended,
        jnp.where(ended, 0.0, value),
        jnp.where(ended, 0, length),
        jnp.where(players.ended, 0.0, gamma * players.running_return) + reward,
        players.episode + jnp.sum(counts, dtype=jnp.uint32),
        bad,
        log,
    )
    return after, Outcome(obs, reward, terminated, truncated, kept)


def all_finite(*arrays: Array) -> Array:
    """Returns whether all numbers are finite, ``bool[]``."""
    floats = [jnp.isfinite(array).all() for array in arrays if jnp.issubdtype(array.dtype, jnp.floating)]
    return jnp.stack(floats).all() if floats else jnp.bool(True)
