"""The common part of the programs of all loops: chunks of turns, in which environments step and episodes are counted.

A :class:`Program` also says how a run of the host becomes its arguments, and how experience comes back.
"""

from __future__ import annotations

import copy
import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rejeu.core import spaces
from rejeu.core.algorithm import (
    GRADIENT_STEPS,
    TD_ERROR,
    Algorithm,
    AnyArray,
    Clock,
    Explorer,
    Masked,
    Metrics,
    PyTree,
    Rollout,
    Scalar,
    Transition,
)
from rejeu.core.prng import below
from rejeu.envs.functional.protocol import FunctionalEnv
from rejeu.envs.functional.vector import VectorState, reset_done, step_all
from rejeu.envs.masks import FunctionalMask, masked
from rejeu.training.finite import MAX_SKIPPED
from rejeu.training.learner import FINITE, Packing, check, td_error_of, undo
from rejeu.training.run import Run

MAX_TURNS = 1000
"""Turns of a chunk at most. Chunks also end at multiples of it, where the best weights are looked for."""
LOG_SIZE = 2**18
"""Entries of a chunk's log of episodes at most: turns times environments."""

Remake = Callable[[Any], tuple[Algorithm, Explorer]]
"""Makes the algorithm of a configuration, and its exploration."""


class Limits(NamedTuple):
    """The limits of a chunk."""

    n_turns: AnyArray
    """Turns to take, ``int32[]``."""
    progress: AnyArray
    """Progress of schedules after 0, 1, ... turns of the chunk, ``float32 (capacity + 1,)``."""
    learn_from: AnyArray
    """The environment step after which off-policy updates begin, ``uint32[]``."""


class EpisodeLog(NamedTuple):
    """The episodes that ended in a chunk, by turn and environment, ``(capacity, n_envs)``."""

    length: Array
    """Their steps, ``int32``; 0 where none ended."""
    episode_return: Array
    """``float32``, where one ended."""
    success: Array
    """1 or 0 where one ended, NaN if the environment does not say, ``float32``."""


class EpisodeState(NamedTuple):
    """The environments and their running episodes."""

    env: VectorState | None
    """None where the other fields are on the host."""
    obs: PyTree
    """The current observations, in the dtypes of the agent's leaves."""
    ended: Array
    """Where the last turn ended an episode, ``bool (n_envs,)``."""
    episode_return: Array
    """Sum of the rewards of the running episode, ``float32 (n_envs,)``."""
    length: Array
    """Its steps, ``int32 (n_envs,)``."""
    running_return: Array
    """The discounted sum of its rewards, ``float32 (n_envs,)``."""
    n_finished: Array
    """Episodes finished, ``uint32[]``."""


class StepResult(NamedTuple):
    """The result of one step of all environments."""

    obs: PyTree
    """True successors."""
    reward: Array
    """``float32 (n_envs,)``."""
    terminated: Array


class Learned(NamedTuple):
    """The values that updates change."""

    state: PyTree
    """The algorithm's state."""
    metrics: Metrics
    """Of the newest update, ``float32[]`` each; 0 before the first."""
    n_updates: Array
    """Gradient steps in this chunk, ``int32[]``."""
    n_bad: Array
    """Updates in this chunk whose metrics, or with ``skips`` whose state, were not finite, ``int32[]``."""
    in_a_row: Array
    """How many of the newest updates were not finite, ``int32[]``."""


class Carry(NamedTuple):
    """The values that a chunk passes on to the next, apart from the experience."""

    state: PyTree
    """The algorithm's state, packed between chunks; None within."""
    key: Array
    """Root of the random numbers, ``uint32[2]``."""
    explorer: PyTree
    """The state of exploration or of a recurrent policy."""
    action: Array | None
    """Chosen for the observations, not yet taken, in the algorithm's range; None if turns begin with choosing them."""
    episodes: EpisodeState
    counts: PyTree
    """Counters, equal for all runs; ``counts.step`` is the number of environment steps, ``uint32[]``."""
    in_a_row: Array
    """How many of the newest updates were not finite, ``int32[]``."""
    hyper: dict[str, Array]
    """Hyperparameters that differ between runs, ``float32[]``."""


class Loop(NamedTuple):
    """The values that a turn of a chunk passes on to the next."""

    carry: Carry
    experience: PyTree
    """The replay buffer, or the rollout."""
    learned: Learned
    log: EpisodeLog
    nonfinite_env: Array
    """Whether a reward or an observation was not finite in this chunk after a finite action, ``bool[]``."""


class ChunkReport(NamedTuple):
    """The results of a chunk of turns."""

    metrics: Metrics
    n_updates: Array
    n_bad: Array
    is_finite: Array
    """Whether the state is finite after the chunk, ``bool[]``."""
    nonfinite_env: Array
    log: EpisodeLog


@dataclass(frozen=True, kw_only=True)
class Program(ABC):
    """The settings that a program is compiled for. Hashable. Abstract: there is a class for each kind of learning."""

    algorithm: Algorithm
    explorer: Explorer
    config: Any
    packing: Packing
    """Of the algorithm's state."""
    n_envs: int
    capacity: int
    """Turns of a chunk at most."""
    skips: bool
    """Whether updates that leave NaN are undone."""
    stops_at_episode: bool
    """Whether a chunk ends with the first turn in which an episode ends."""
    remake: Remake | None = None
    """Makes the algorithm of a configuration, and its exploration, where hyperparameters differ between runs."""

    @abstractmethod
    def batch(self, env: FunctionalEnv, carry: Carry, experience: PyTree, clock: Clock, number: Array | int) -> PyTree:
        """Returns the batch of the ``number``-th gradient step of a turn that ends at ``clock``."""

    @abstractmethod
    def turns(self, env: FunctionalEnv, loop: Loop, limits: Limits, may_go_on: Callable[[Array, Loop], Array]) -> Loop:
        """Returns the loop after turns, which are taken while ``may_go_on(number of turns, loop)``."""

    @abstractmethod
    def begin_episodes(self, run: Run) -> None:
        """Starts an episode in every environment of a run."""

    @abstractmethod
    def counts_of(self, run: Run) -> PyTree:
        """Returns the counters of a run."""

    @abstractmethod
    def action_of(self, run: Run) -> Array | None:
        """Returns :attr:`Carry.action`; where none was chosen yet, any of its shape."""

    @abstractmethod
    def upload(self, run: Run) -> PyTree:
        """Returns the experience of a run, on the device."""

    @abstractmethod
    def download(self, run: Run, experience: PyTree, counts: PyTree) -> None:
        """Copies experience on the device into the buffer of a run."""

    @abstractmethod
    def pull_counts(self, run: Run, carry: Carry) -> None:
        """Copies what only this kind of learning counts into a run."""

    def chunk(
        self, env: FunctionalEnv, carry: Carry, experience: PyTree, limits: Limits
    ) -> tuple[Carry, PyTree, ChunkReport]:
        """Returns carry, experience and report after a number of turns."""
        program = self.with_hyperparameters(carry.hyper)
        first_episode = carry.episodes.n_finished
        state, carry = program.packing.unpack(carry.state), carry._replace(state=None)
        loop = Loop(
            carry,
            experience,
            program.nothing_learned(env, state, carry, experience),
            empty_log(program.capacity, program.n_envs),
            jnp.bool(False),
        )

        def may_go_on(i: Array, loop: Loop) -> Array:
            more = i < limits.n_turns
            return more & (loop.carry.episodes.n_finished == first_episode) if program.stops_at_episode else more

        loop = program.turns(env, loop, limits, may_go_on)
        learned = loop.learned
        is_finite = check(jax.tree.leaves(learned.state), {})
        counted = learned.metrics, learned.n_updates, learned.n_bad
        report = ChunkReport(*counted, is_finite, loop.nonfinite_env, loop.log)
        carry = loop.carry._replace(state=program.packing.pack(learned.state), in_a_row=learned.in_a_row)
        return carry, loop.experience, report

    def with_hyperparameters(self, hyper: dict[str, Array]) -> Any:
        """Returns the program for the hyperparameters ``float32[]`` of one run."""
        if self.remake is None:
            return self
        config = changed(self.config, hyper)
        algorithm, explorer = self.remake(config)
        return dataclasses.replace(self, algorithm=algorithm, explorer=explorer, config=config)

    def nothing_learned(self, env: FunctionalEnv, state: PyTree, carry: Carry, experience: PyTree) -> Learned:
        """Returns the state and metrics before the first update: metrics are 0. The update is only traced."""

        def update(state: PyTree, carry: Carry, experience: PyTree) -> tuple[PyTree, Metrics]:
            clock = Clock(jnp.uint32(0), jnp.uint32(0), jnp.float32(0))
            return self.algorithm.update(state, self.batch(env, carry, experience, clock, 0), clock)

        _, shapes = jax.eval_shape(update, state, carry, experience)
        metrics = {name: jnp.float32(0) for name in shapes if name != TD_ERROR}
        return Learned(state, metrics, jnp.int32(0), jnp.int32(0), carry.in_a_row)

    def learn(self, learned: Learned, batch: Transition | Rollout, clock: Clock) -> tuple[Learned, Array | None]:
        """Returns the state and metrics after an update on a batch, and the TD errors if the batch has importance weights.

        With ``skips``, an update that leaves NaN is undone, and its TD errors are NaN.
        """
        after, stats = self.algorithm.update(learned.state, batch, clock)
        td_error = td_error_of(stats, batch)
        stats = {name: jnp.mean(jnp.asarray(value, jnp.float32)) for name, value in stats.items() if name != TD_ERROR}
        n = stats[GRADIENT_STEPS].astype(jnp.int32) if GRADIENT_STEPS in stats else 1
        if self.skips:
            after, stats = undo(learned.state, after, stats)
            is_bad = ~stats.pop(FINITE)
            td_error = None if td_error is None else jnp.where(is_bad, jnp.nan, td_error)
        else:
            is_bad = ~check((), stats)
        is_over = learned.in_a_row >= MAX_SKIPPED  # the turns after it, in the same chunk, do not count
        in_a_row = jnp.where(is_bad | is_over, learned.in_a_row + ~is_over, 0)
        return Learned(after, stats, learned.n_updates + n, learned.n_bad + is_bad, in_a_row), td_error


def capacity_of(n_envs: int) -> int:
    """Returns the turns of a chunk at most, for that number of environments."""
    return max(min(MAX_TURNS, LOG_SIZE // n_envs), 1)


def changed(config: Any, hyper: dict[str, Array]) -> Any:
    """Returns a configuration with traced numbers, whose checks are left out, since they need the values."""
    copied = copy.copy(config)
    for name, value in hyper.items():
        object.__setattr__(copied, name, value)
    return copied


def empty_log(capacity: int, n_envs: int) -> EpisodeLog:
    """Returns a log without episodes."""
    shape = (capacity, n_envs)
    return EpisodeLog(jnp.zeros(shape, jnp.int32), jnp.zeros(shape, jnp.float32), jnp.zeros(shape, jnp.float32))


def observed(env: FunctionalEnv, obs: PyTree) -> PyTree:
    """Returns a batch of observations as agents see them: with the mask apart if there is one."""
    if isinstance(env, FunctionalMask):
        parts = masked(obs)
        return Masked(observed(env.env, parts.obs), parts.mask)
    return plain(env.observation_space, obs)


def plain(space: gym.Space, obs: PyTree) -> PyTree:
    """Returns a batch of observations in the structure and dtypes in which agents see them."""
    leaves = spaces.leaves(space)
    parts = [jnp.asarray(x).astype(leaf.dtype) for x, leaf in zip(jax.tree.leaves(obs), leaves, strict=True)]
    return jax.tree.unflatten(spaces.structure(space), parts)


def step_envs(program: Program, env: FunctionalEnv, loop: Loop, action: Array, turn: Array) -> tuple[Loop, StepResult]:
    """Takes one step of all environments, and starts new episodes where some ended; returns what is passed on, and the step.

    Args:
        program: what is compiled.
        env: the environment.
        loop: before the step.
        action: in the range of algorithms, ``(n_envs, ...)``.
        turn: the number of the turn in the chunk, ``int32[]``.
    """
    before = loop.carry.episodes
    assert before.env is not None
    space = spaces.limited(env.action_space, program.config.action_share)
    scaled = spaces.scale_action(space, action, jnp)
    vstate, obs, reward, terminated, truncated, success = step_all(env, before.env, scaled)
    obs, reward = observed(env, obs), reward.astype(jnp.float32)
    episode_return, length = before.episode_return + reward, before.length + 1
    ended = terminated | truncated
    log = EpisodeLog(
        loop.log.length.at[turn].set(jnp.where(ended, length, 0)),
        loop.log.episode_return.at[turn].set(episode_return),
        loop.log.success.at[turn].set(
            jnp.full_like(episode_return, jnp.nan) if success is None else success.astype(jnp.float32)
        ),
    )
    vstate, fresh = reset_done(env, vstate, ended)
    fresh = observed(env, fresh)
    episodes = EpisodeState(
        vstate,
        fresh,
        ended,
        jnp.where(ended, 0.0, episode_return),
        jnp.where(ended, 0, length),
        jnp.where(before.ended, 0.0, program.config.gamma * before.running_return) + reward,
        before.n_finished + jnp.sum(ended, dtype=jnp.uint32),
    )
    spoiled = all_finite(action) & ~all_finite(reward, *jax.tree.leaves((obs, fresh)))
    carry, nonfinite_env = loop.carry._replace(episodes=episodes), loop.nonfinite_env | spoiled
    return loop._replace(carry=carry, log=log, nonfinite_env=nonfinite_env), StepResult(obs, reward, terminated)


def all_finite(*arrays: Array) -> Array:
    """Returns whether all numbers are finite, ``bool[]``."""
    floats = [jnp.isfinite(array).all() for array in arrays if jnp.issubdtype(array.dtype, jnp.floating)]
    return jnp.stack(floats).all() if floats else jnp.bool(True)


def random_action(space: gym.Space, n: int, key: Array, mask: Array | None = None) -> Array:
    """Returns :func:`rejeu.core.spaces.random_action` with the random numbers of a key."""
    if isinstance(space, gym.spaces.Dict | gym.spaces.Tuple):
        keys = [jax.random.fold_in(key, i) for i in range(len(space.spaces))]
        members = zip(spaces.members(space), keys, strict=True)
        parts = [random_action(member, n, part_key).reshape(n, -1).astype(jnp.float32) for member, part_key in members]
        return jnp.concatenate(parts, axis=-1)
    return jnp.asarray(spaces.random_action(space, n, KeyGenerator(key), mask))


class KeyGenerator:
    """The methods of NumPy's generator that random actions use, with the random numbers of a key."""

    def __init__(self, key: Array) -> None:
        self.key = key

    def integers(self, high: Scalar, size: Any = None, dtype: type[np.generic] = np.int32) -> Array:
        """Returns whole numbers from 0 to ``high - 1``."""
        high = jnp.asarray(high, dtype)
        bits = jax.random.bits(self.key, high.shape if size is None else (size,) if isinstance(size, int) else size)
        return below(bits, high if high.ndim in (0, bits.ndim) else high[None])

    def uniform(self, low: float, high: float, size: tuple[int, ...]) -> Array:
        """Returns numbers from ``low`` to ``high``, both not too far from 0."""
        unit = (jax.random.bits(self.key, size) >> 8).astype(jnp.float32)
        return unit * jnp.float32((high - low) * 2.0**-24) + jnp.float32(low)
