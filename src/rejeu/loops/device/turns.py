"""What a turn of every loop on the device does: the environments step, episodes are counted, new ones begin."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import jax
import jax.numpy as jnp
from jax import Array

from rejeu import spaces
from rejeu.core import GRADIENT_STEPS, TD_ERROR, Algorithm, Clock, Masked, Metrics, PyTree, Rollout, Transition
from rejeu.envs.functional.masks import MaskInObservation
from rejeu.envs.functional.protocol import FunctionalEnv
from rejeu.envs.functional.vector import VectorState, reset_done, step_all
from rejeu.envs.masks import masked
from rejeu.loops import nonfinite
from rejeu.loops.device.actions import scale
from rejeu.loops.learner import td_error_of

NO_LIMIT = 2**32 - 1
"""The value for no last step; steps are counted in ``uint32``."""


class Limits(NamedTuple):
    """The limits of a chunk."""

    n_turns: Any
    """Turns to take, ``int32[]``."""
    last: Any
    """Total environment steps at which training ends, ``uint32[]``, ``NO_LIMIT`` for never."""
    progress: Any
    """Progress of schedules after 0, 1, ... turns of the chunk, ``float32 (capacity + 1,)``."""
    most_updates: Any
    """Gradient steps of a turn at most, or updates from rollouts, ``int32[]``; used to find the one that left NaN."""
    learn_from: Any
    """The environment step after which off-policy updates begin, ``uint32[]``."""
    uses_part: Any
    """Whether an incomplete rollout is learned from at the last step, ``bool[]``."""


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
    action: Array
    """What was done, in the range of algorithms."""


class Report(NamedTuple):
    """The results of a chunk of turns."""

    metrics: Metrics
    """Of the newest update, ``float32[]`` each; 0 before the first."""
    n_updates: Array
    """Gradient steps, ``int32[]``."""
    n_bad: Array
    """Updates whose metrics, or with ``skips`` whose state, were not finite, ``int32[]``."""
    is_finite: Array
    """Whether the state is finite after the chunk, ``bool[]``."""
    outcome: Outcome
    """Of the newest turn."""
    log: Log


class Learned(NamedTuple):
    """What updates change."""

    state: PyTree
    """The algorithm's state."""
    metrics: Metrics
    """Of the newest update."""
    n_updates: Array
    """Gradient steps in this chunk, ``int32[]``."""
    n_bad: Array
    """Updates in this chunk that were not finite, ``int32[]``."""
    in_a_row: Array
    """How many of the newest updates were not finite, ``int32[]``."""


def learn(
    algorithm: Algorithm, learned: Learned, batch: Transition | Rollout, clock: Clock, skips: bool
) -> tuple[Learned, Array | None]:
    """Returns what is learned from a batch, and the TD errors if the batch has importance weights.

    With ``skips``, an update that leaves NaN is undone, and its TD errors are NaN.
    """
    after, found = algorithm.update(learned.state, batch, clock)
    td_error = td_error_of(found, batch)
    found = {name: jnp.mean(jnp.asarray(value, jnp.float32)) for name, value in found.items() if name != TD_ERROR}
    n = found[GRADIENT_STEPS].astype(jnp.int32) if GRADIENT_STEPS in found else 1
    if skips:
        after, found = nonfinite.undo(learned.state, after, found)
        is_bad = ~found.pop(nonfinite.FINITE)
        td_error = None if td_error is None else jnp.where(is_bad, jnp.nan, td_error)
    else:
        is_bad = ~nonfinite.check((), found)
    is_over = learned.in_a_row >= nonfinite.MAX_SKIPPED  # the turns after it, in the same chunk, do not count
    in_a_row = jnp.where(is_bad | is_over, learned.in_a_row + ~is_over, 0)
    return Learned(after, found, learned.n_updates + n, learned.n_bad + is_bad, in_a_row), td_error


def nothing_learned(
    update: Callable[..., tuple[PyTree, Metrics]], state: PyTree, in_a_row: Array, *arguments: Any
) -> Learned:
    """Returns what is learned before the first update: metrics are 0.

    ``update`` of the state and ``arguments`` returns state and metrics; it is only traced.
    """
    _, found = jax.eval_shape(update, state, *arguments)
    metrics = {name: jnp.float32(0) for name in found if name != TD_ERROR}
    return Learned(state, metrics, jnp.int32(0), jnp.int32(0), in_a_row)


def report_of(learned: Learned, players: Players, outcome: Outcome) -> Report:
    """Returns the report of a chunk after its last turn."""
    is_finite = nonfinite.check(jax.tree.leaves(learned.state), {})
    return Report(learned.metrics, learned.n_updates, learned.n_bad, is_finite, outcome, players.log)


def begun(players: Players, capacity: int) -> Players:
    """Returns the environments at the beginning of a chunk."""
    return players._replace(log=empty_log(capacity, len(players.ended)), bad=jnp.bool(False))


def no_outcome(players: Players, action: Array) -> Outcome:
    """Returns the outcome before the first turn of a chunk; ``action`` has the shape of actions."""
    n_envs = len(players.ended)
    never = jnp.zeros(n_envs, bool)
    return Outcome(players.obs, jnp.zeros(n_envs, jnp.float32), never, never, never, action)


def observed(env: FunctionalEnv, obs: PyTree) -> PyTree:
    """Returns a batch of observations as agents see them: with the mask apart if there is one."""
    if isinstance(env, MaskInObservation):
        parts = masked(obs)
        return Masked(observed(env.env, parts.obs), parts.mask)
    return plain(env.observation_space, obs)


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
    obs, reward = observed(env, obs), reward.astype(jnp.float32)
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
    fresh = observed(env, fresh)
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
    return after, Outcome(obs, reward, terminated, truncated, kept, action)


def all_finite(*arrays: Array) -> Array:
    """Returns whether all numbers are finite, ``bool[]``."""
    floats = [jnp.isfinite(array).all() for array in arrays if jnp.issubdtype(array.dtype, jnp.floating)]
    return jnp.stack(floats).all() if floats else jnp.bool(True)
