"""Off-policy learning in one program: the turns of :mod:`rejeu.loops.off_policy`, on the device.

Everything happens in the order of the host's loop, with the same functions of the algorithm and the same keys. Only the
random numbers of batches, goals and of the first actions come from JAX instead of NumPy: they are functions of the
environment step, so a run needs no state of a generator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rejeu.algorithms.config import OffPolicyConfig
from rejeu.buffers.device import DeviceReplay, DeviceRing
from rejeu.core import TD_ERROR, Algorithm, Clock, Explorer, Metrics, PyTree, Transition
from rejeu.envs.functional.protocol import FunctionalEnv, GoalEnv
from rejeu.loops import nonfinite
from rejeu.loops.device.actions import random_action
from rejeu.loops.device.turns import Limits, Log, Outcome, Players, empty_log, kept_steps, play
from rejeu.loops.packing import Packing
from rejeu.prng import nth

DRAWS = 2**32 - 1
"""Number of the key of batches and random actions; those before are the keys of exploration, by environment step."""


class Counts(NamedTuple):
    """Counters of a run, equal for all seeds unless updates depend on episodes."""

    step: Array
    """Environment steps, ``uint32[]``."""
    owed: Array
    """See :attr:`rejeu.loops.run.Run.owed`, ``int32[]``."""
    since_update: Array
    """Environment steps since the last update, ``int32[]``."""
    n_updates: Array
    """Gradient steps in this chunk, ``int32[]``."""


class Carry(NamedTuple):
    """What the turns of a chunk pass on, apart from the replay buffer."""

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


class Report(NamedTuple):
    """What a chunk says of its turns."""

    metrics: Metrics
    """Of the newest gradient step, ``float32[]`` each; 0 before the first."""
    n_bad: Array
    """Gradient steps whose metrics, or with ``skips`` whose state, were not finite, ``int32[]``."""
    is_finite: Array
    """Whether the state is finite after the chunk, ``bool[]``."""
    outcome: Outcome
    """Of the newest turn."""
    log: Log


class Loop(NamedTuple):
    """What the turns of a chunk pass on."""

    carry: Carry
    ring: DeviceRing
    metrics: Metrics
    n_bad: Array
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


def chunk(
    program: OffPolicyProgram, env: FunctionalEnv, carry: Carry, ring: DeviceRing, learn_from: Array, limits: Limits
) -> tuple[Carry, DeviceRing, Report]:
    """Returns carry, replay buffer and report after a number of turns."""
    first_episode = carry.players.episode
    no_log = carry.players.log
    players = carry.players._replace(log=empty_log(program.capacity, program.replay.n_envs), bad=jnp.bool(False))
    state = program.packing.unpack(carry.state)
    counts = carry.counts._replace(n_updates=jnp.int32(0))
    carry = carry._replace(state=state, players=players, counts=counts)
    loop = Loop(carry, ring, no_metrics(program, env, carry, ring), jnp.int32(0), no_outcome(players))

    def continues(loop: tuple[Array, Loop]) -> Array:
        more = loop[0] < limits.n_turns
        return more & (loop[1].carry.players.episode == first_episode) if program.stops_at_episode else more

    def one(loop: tuple[Array, Loop]) -> tuple[Array, Loop]:
        return loop[0] + 1, turn(program, env, loop[1], learn_from, limits, loop[0])

    _, loop = jax.lax.while_loop(continues, one, (jnp.int32(0), loop))
    carry = loop.carry
    report = Report(
        loop.metrics,
        loop.n_bad,
        nonfinite.check(jax.tree.leaves(carry.state), {}),
        loop.outcome,
        carry.players.log,
    )
    carry = carry._replace(state=program.packing.pack(carry.state), players=carry.players._replace(log=no_log))
    return carry, loop.ring, report


def no_outcome(players: Players) -> Outcome:
    """Returns the outcome before the first turn of a chunk."""
    n_envs = len(players.ended)
    never = jnp.zeros(n_envs, bool)
    return Outcome(players.obs, jnp.zeros(n_envs, jnp.float32), never, never, never)


def no_metrics(program: OffPolicyProgram, env: FunctionalEnv, carry: Carry, ring: DeviceRing) -> Metrics:
    """Returns the metrics before the first gradient step: 0 each."""
    clock = Clock(jnp.uint32(0), jnp.uint32(0), jnp.float32(0))

    def update(state: PyTree, ring: DeviceRing, key: Array) -> Metrics:
        batch = draw(program.replay, env, ring, jax.random.fold_in(draws(key, clock.step), 0))
        return program.algorithm.update(state, batch, clock)[1]

    found = jax.eval_shape(update, carry.state, ring, carry.key)
    return {name: jnp.float32(0) for name in found if name != TD_ERROR}


def turn(
    program: OffPolicyProgram, env: FunctionalEnv, loop: Loop, learn_from: Array, limits: Limits, i: Array
) -> Loop:
    """Returns what the ``i``-th turn of a chunk passes on."""
    config, algorithm, replay, carry = program.config, program.algorithm, program.replay, loop.carry
    kept = kept_steps(carry.counts.step, limits.last, replay.n_envs)
    players, outcome = play(env, carry.players, carry.action, kept, config.gamma, i)
    ring = replay.add(loop.ring, carry.action, outcome.reward, outcome.terminated, outcome.obs, kept)
    ring = replay.begin(ring, players.obs, players.ended)
    state = carry.state
    if algorithm.observe is not None:
        state = algorithm.observe(state, players.obs, players.running_return)
    n_ended = (players.episode - carry.players.episode).astype(jnp.int32)
    n_updates, counts = due(config, carry.counts, jnp.sum(kept, dtype=jnp.int32), n_ended, learn_from)
    clock = Clock(counts.step, players.episode, limits.progress[i + 1])
    carry = carry._replace(state=state, players=players, counts=counts)
    if config.overlap:
        carry = choose(program, env, carry, clock)
    loop = Loop(carry, ring, loop.metrics, loop.n_bad, outcome)
    loop = updates(program, env, loop, clock, jnp.minimum(n_updates, limits.most_updates))
    return loop if config.overlap else loop._replace(carry=choose(program, env, loop.carry, clock))


def draws(key: Array, step: Array) -> Array:
    """Returns the key of the random actions and batches of a turn that ends at the environment step ``step``."""
    return jax.random.fold_in(nth(key, jnp.uint32(DRAWS)), step)


def choose(program: OffPolicyProgram, env: FunctionalEnv, carry: Carry, clock: Clock) -> Carry:
    """Returns the carry with the actions of the next turn; see :func:`rejeu.loops.off_policy.choose`."""
    players = carry.players

    def explored() -> tuple[Array, PyTree]:
        actor, key = program.algorithm.actor(carry.state), nth(carry.key, clock.step)
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


def updates(program: OffPolicyProgram, env: FunctionalEnv, loop: Loop, clock: Clock, n: Array) -> Loop:
    """Returns what is passed on after ``n`` gradient steps."""
    carry, ring = loop.carry, loop.ring
    root = draws(carry.key, clock.step)

    def one(u: Array, inner: tuple[PyTree, Metrics, Array, Array]) -> tuple[PyTree, Metrics, Array, Array]:
        state, _, n_bad, in_a_row = inner
        batch = draw(program.replay, env, ring, jax.random.fold_in(root, u + 1))
        after, found = program.algorithm.update(state, batch, clock)
        found = {name: jnp.mean(jnp.asarray(value, jnp.float32)) for name, value in found.items() if name != TD_ERROR}
        if program.skips:
            after, found = nonfinite.undo(state, after, found)
            is_bad = ~found.pop(nonfinite.FINITE)
        else:
            is_bad = ~nonfinite.check((), found)
        return after, found, n_bad + is_bad, jnp.where(is_bad, in_a_row + 1, 0)

    begin = (carry.state, loop.metrics, loop.n_bad, carry.in_a_row)
    state, metrics, n_bad, in_a_row = jax.lax.fori_loop(0, n, one, begin)
    counts = carry.counts._replace(n_updates=carry.counts.n_updates + n)
    return loop._replace(
        carry=carry._replace(state=state, in_a_row=in_a_row, counts=counts), metrics=metrics, n_bad=n_bad
    )


def draw(replay: DeviceReplay, env: FunctionalEnv, ring: DeviceRing, key: Array) -> Transition:
    """Returns a batch; with hindsight, the rewards of new goals are those of ``env``."""
    if replay.strategy is None:
        return replay.draw(ring, key)
    assert isinstance(env, GoalEnv)
    goal = ring.obs[replay.achieved][:1]
    judges = jax.eval_shape(env.compute_terminated, goal, goal) is not None
    return replay.draw(ring, key, env.compute_reward, env.compute_terminated if judges else None)  # type: ignore[arg-type]


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
    return n, Counts(step, owed, jnp.where(times > 0, 0, since), counts.n_updates)
