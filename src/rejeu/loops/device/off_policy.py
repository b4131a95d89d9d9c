"""Off-policy learning in one program: the turns of :mod:`rejeu.loops.off_policy`, on the device.

Everything happens in the order of the host's loop, with the same functions of the algorithm and the same keys. Only the
random numbers of batches, goals and of the first actions come from JAX instead of NumPy: they are functions of the
environment step, so a run needs no state of a generator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rejeu.algorithms.config import OffPolicyConfig
from rejeu.buffers.device import DeviceReplay, DeviceRing, DeviceRows
from rejeu.buffers.device_priorities import Pending, noted
from rejeu.core import Algorithm, Clock, Explorer, Metrics, PyTree, Transition
from rejeu.envs.functional.protocol import FunctionalEnv, GoalEnv
from rejeu.loops.device.actions import random_action
from rejeu.loops.device.turns import (
    Learned,
    Limits,
    Outcome,
    Players,
    Report,
    begun,
    kept_steps,
    learn,
    no_outcome,
    nothing_learned,
    play,
    report_of,
)
from rejeu.loops.device.variants import Variants
from rejeu.loops.packing import Packing
from rejeu.prng import nth

DRAWS = 2**32 - 1
"""Number of the key of batches and random actions; those before are the keys of exploration, by environment step."""


class Counts(NamedTuple):
    """Counters of a run, equal for all seeds."""

    step: Array
    """Environment steps, ``uint32[]``."""
    owed: Array
    """See :attr:`rejeu.loops.run.Run.owed`, ``int32[]``."""
    since_update: Array
    """Environment steps since the last update, ``int32[]``."""
    pending: Array
    """Gradient steps of the last turn, whose TD errors set priorities in the next, ``int32[]``."""


class Carry(NamedTuple):
    """What a chunk passes on, apart from the replay buffer."""

    state: PyTree
    """The algorithm's state, packed between chunks."""
    key: Array
    """Root of the random numbers, ``uint32[2]``."""
    explorer: PyTree
    """The state of exploration."""
    action: Array
    """Chosen for the observations, not yet taken; in the algorithm's range."""
    players: Players
    counts: Counts
    in_a_row: Array
    """How many of the newest gradient steps were not finite, ``int32[]``."""
    hyper: dict[str, Array]
    """Hyperparameters that differ between runs; see :class:`Variants`."""


class Loop(NamedTuple):
    """What the turns of a chunk pass on. The states in ``carry`` and ``learned`` are the same."""

    carry: Carry
    ring: DeviceRing
    learned: Learned
    outcome: Outcome


@dataclass(frozen=True)
class OffPolicyProgram:
    """What the program is compiled for. Hashable."""

    algorithm: Algorithm
    explorer: Explorer
    config: OffPolicyConfig
    replay: DeviceReplay
    packing: Packing
    """Of the algorithm's state."""
    capacity: int
    """Turns of a chunk at most."""
    skips: bool
    """Whether updates that leave NaN are undone."""
    stops_at_episode: bool
    """Whether a chunk ends with the first turn in which an episode ends."""
    variants: Variants | None = None
    """What makes the algorithm of runs whose hyperparameters differ."""

    def chunk(
        self, env: FunctionalEnv, carry: Carry, ring: DeviceRing, limits: Limits
    ) -> tuple[Carry, DeviceRing, Report]:
        """Returns carry, replay buffer and report after a number of turns."""
        program = self if self.variants is None else self.variants.applied(self, carry.hyper)
        no_log, first_episode = carry.players.log, carry.players.episode
        state = program.packing.unpack(carry.state)
        carry = carry._replace(state=None, players=begun(carry.players, program.capacity))

        def update(state: PyTree, ring: DeviceRing, key: Array) -> tuple[PyTree, Metrics]:
            clock = Clock(jnp.uint32(0), jnp.uint32(0), jnp.float32(0))
            batch, _ = draw(program.replay, env, ring, nth(key, jnp.uint32(0)), clock.progress)
            return program.algorithm.update(state, batch, clock)

        learned = nothing_learned(update, state, carry.in_a_row, ring, carry.key)
        loop = Loop(carry, ring, learned, no_outcome(carry.players, carry.action))

        def continues(loop: tuple[Array, Loop]) -> Array:
            more = loop[0] < limits.n_turns
            return more & (loop[1].carry.players.episode == first_episode) if program.stops_at_episode else more

        def one(loop: tuple[Array, Loop]) -> tuple[Array, Loop]:
            return loop[0] + 1, turn(program, env, loop[1], limits, loop[0])

        _, loop = jax.lax.while_loop(continues, one, (jnp.int32(0), loop))
        report = report_of(loop.learned, loop.carry.players, loop.outcome)
        carry = loop.carry._replace(
            state=program.packing.pack(loop.learned.state),
            players=loop.carry.players._replace(log=no_log),
            in_a_row=loop.learned.in_a_row,
        )
        return carry, loop.ring, report


def turn(program: OffPolicyProgram, env: FunctionalEnv, loop: Loop, limits: Limits, i: Array) -> Loop:
    """Returns what the ``i``-th turn of a chunk passes on."""
    config, algorithm, replay, carry = program.config, program.algorithm, program.replay, loop.carry
    kept = kept_steps(carry.counts.step, limits.last, replay.n_envs)
    players, outcome = play(env, carry.players, carry.action, kept, config.gamma, i)
    ring = replay.add(loop.ring, carry.action, outcome.reward, outcome.terminated, outcome.obs, kept)
    ring = replay.begin(ring, players.obs, players.ended)
    learned = loop.learned
    if algorithm.observe is not None:
        learned = learned._replace(state=algorithm.observe(learned.state, players.obs, players.running_return))
    n_ended = (players.episode - carry.players.episode).astype(jnp.int32)
    n, counts = due(config, carry.counts, jnp.sum(kept, dtype=jnp.int32), n_ended, limits.learn_from)
    clock = Clock(counts.step, players.episode, limits.progress[i + 1])
    n_pending = jnp.where(n <= limits.most_updates, carry.counts.pending, 0)
    carry = carry._replace(players=players, counts=counts)
    root = draws(carry.key, clock.step)

    def one(u: Array, passed: tuple[Learned, Pending | None]) -> tuple[Learned, Pending | None]:
        learned, pending = passed
        batch, rows = draw(replay, env, ring, jax.random.fold_in(root, u + 1), clock.progress)
        learned, td_error = learn(algorithm, learned, batch, clock, program.skips)
        if pending is not None and td_error is not None:
            pending = noted(pending, u, rows.position, rows.time, td_error)
        return learned, pending

    if config.overlap:
        carry = choose(program, env, carry, learned.state, clock)
    pending = None if ring.priorities is None else ring.priorities.pending
    learned, pending = jax.lax.fori_loop(0, jnp.minimum(n, limits.most_updates), one, (learned, pending))
    if not config.overlap:
        carry = choose(program, env, carry, learned.state, clock)
    ring = replay.update_priorities(ring, n_pending)  # all batches of the turn have been drawn
    if pending is not None and ring.priorities is not None:
        ring = ring._replace(priorities=ring.priorities._replace(pending=pending))
    return Loop(carry, ring, learned, outcome)


def draws(key: Array, step: Array) -> Array:
    """Returns the key of the random actions and batches of a turn that ends at the environment step ``step``."""
    return jax.random.fold_in(nth(key, jnp.uint32(DRAWS)), step)


def choose(program: OffPolicyProgram, env: FunctionalEnv, carry: Carry, state: PyTree, clock: Clock) -> Carry:
    """Returns the carry with the actions of the next turn; see :func:`rejeu.loops.off_policy.choose`."""
    players = carry.players

    def explored() -> tuple[Array, PyTree]:
        actor, key = program.algorithm.actor(state), nth(carry.key, clock.step)
        action, explorer = program.explorer.act(carry.explorer, actor, players.obs, players.ended, key, clock)
        return action.astype(carry.action.dtype), explorer

    def random() -> tuple[Array, PyTree]:
        key = jax.random.fold_in(draws(carry.key, clock.step), 0)
        return random_action(env.action_space, program.replay.n_envs, key).astype(carry.action.dtype), carry.explorer

    if program.config.learning_starts:
        action, explorer = jax.lax.cond(clock.step < program.config.learning_starts, random, explored)
    else:
        action, explorer = explored()
    return carry._replace(action=action, explorer=explorer)


def draw(
    replay: DeviceReplay, env: FunctionalEnv, ring: DeviceRing, key: Array, progress: Array
) -> tuple[Transition, DeviceRows]:
    """Returns a batch and its rows; with hindsight, the rewards of new goals are those of ``env``."""
    if replay.strategy is None:
        return replay.draw(ring, key, progress)
    assert isinstance(env, GoalEnv)
    goal = ring.obs[replay.achieved][:1]
    judges = jax.eval_shape(env.compute_terminated, goal, goal) is not None
    terminated: Any = env.compute_terminated if judges else None
    return replay.draw(ring, key, progress, env.compute_reward, terminated)


def due(config: OffPolicyConfig, counts: Counts, taken: Array, ended: Array, learn_from: Array) -> tuple[Array, Counts]:
    """Returns the gradient steps of a turn of ``taken`` steps, and the counters after it; see the host's ``due``."""
    step = counts.step + taken.astype(jnp.uint32)
    learns = step > learn_from
    counted = jnp.where(learns, jnp.minimum(taken.astype(jnp.uint32), step - learn_from).astype(jnp.int32), 0)
    since = counts.since_update + counted
    if isinstance(config.train_freq, int):
        owed, every = counts.owed + counted, config.train_freq
    else:
        owed, every = counts.owed + jnp.where(learns, ended, 0), config.train_freq[0]
    times, owed = jnp.divmod(owed, every)
    n = since if config.gradient_steps == -1 else times * config.gradient_steps
    n = jnp.where(times > 0, n, 0)
    return n, Counts(step, owed, jnp.where(times > 0, 0, since), n)


def most_updates(config: OffPolicyConfig, n_envs: int) -> int | None:
    """Returns the largest number of gradient steps of a turn; None if it depends on the length of episodes.

    >>> most_updates(OffPolicyConfig(train_freq=4, gradient_steps=2), n_envs=10)
    6
    """
    every = config.train_freq if isinstance(config.train_freq, int) else config.train_freq[0]
    if config.gradient_steps != -1:
        return (every - 1 + n_envs) // every * config.gradient_steps
    return every - 1 + n_envs if isinstance(config.train_freq, int) else None
