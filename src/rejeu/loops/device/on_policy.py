"""On-policy learning in one program: the turns of :mod:`rejeu.loops.on_policy`, on the device.

Everything happens in the order of the host's loop, with the same functions of the algorithm and the same keys.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rejeu.algorithms.rollout_config import RolloutConfig
from rejeu.core import Algorithm, Clock, Explorer, Metrics, PyTree, Rollout
from rejeu.envs.functional.protocol import FunctionalEnv
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


class Counts(NamedTuple):
    """Counters of a run, equal for all seeds."""

    step: Array
    """Environment steps, ``uint32[]``."""
    length: Array
    """Turns of the current rollout, ``int32[]``."""


class Carry(NamedTuple):
    """What a chunk passes on, apart from the rollout."""

    state: PyTree
    """The algorithm's state, packed between chunks."""
    key: Array
    """Root of the random numbers, ``uint32[2]``."""
    explorer: PyTree
    """The state of exploration or of a recurrent policy."""
    players: Players
    counts: Counts
    in_a_row: Array
    """How many of the newest updates were not finite, ``int32[]``."""
    hyper: dict[str, Array]
    """Hyperparameters that differ between runs; see :class:`Variants`."""


class Steps(NamedTuple):
    """The rollout: its steps ``(n_steps, n_envs, ...)``, and how it began. The fields are those of ``RolloutBuffer``."""

    obs: PyTree
    next_obs: PyTree
    action: Array
    reward: Array
    discount: Array
    ended: Array
    valid: Array
    running_return: Array
    started: Array
    """``bool (n_envs,)``."""
    carry: PyTree
    """The state of a recurrent policy before the first step."""


class Loop(NamedTuple):
    """What the turns of a chunk pass on. The state is that in ``learned``."""

    carry: Carry
    steps: Steps
    learned: Learned
    outcome: Outcome


@dataclass(frozen=True)
class OnPolicyProgram:
    """What the program is compiled for. Hashable."""

    algorithm: Algorithm
    explorer: Explorer
    config: RolloutConfig
    n_envs: int
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

    def chunk(self, env: FunctionalEnv, carry: Carry, steps: Steps, limits: Limits) -> tuple[Carry, Steps, Report]:
        """Returns carry, rollout and report after a number of turns."""
        program = self if self.variants is None else self.variants.applied(self, carry.hyper)
        no_log, first_episode = carry.players.log, carry.players.episode
        state = program.packing.unpack(carry.state)
        carry = carry._replace(state=None, players=begun(carry.players, program.capacity))

        def update(state: PyTree, steps: Steps) -> tuple[PyTree, Metrics]:
            clock = Clock(jnp.uint32(0), jnp.uint32(0), jnp.float32(0))
            return program.algorithm.update(state, rollout_of(steps, jnp.int32(0)), clock)

        learned = nothing_learned(update, state, carry.in_a_row, steps)
        loop = Loop(carry, steps, learned, no_outcome(carry.players, steps.action[0]))

        def may_go_on(i: Array, loop: Loop) -> Array:
            more = i < limits.n_turns
            return more & (loop.carry.players.episode == first_episode) if program.stops_at_episode else more

        def fills(inner: tuple[Array, Loop]) -> Array:
            return may_go_on(*inner) & (inner[1].carry.counts.length < program.config.n_steps)

        def one_turn(inner: tuple[Array, Loop]) -> tuple[Array, Loop]:
            i, loop = inner
            return i + 1, turn(program, env, loop, limits, i)

        def one_rollout(outer: tuple[Array, Loop, Array]) -> tuple[Array, Loop, Array]:
            i, loop = jax.lax.while_loop(fills, one_turn, outer[:2])
            counts = loop.carry.counts
            is_done = (counts.length == program.config.n_steps) | (limits.uses_part & (counts.step == limits.last))
            is_done &= outer[2] < limits.most_updates
            clock = Clock(counts.step, loop.carry.players.episode, limits.progress[i])
            loop = jax.lax.cond(is_done, lambda loop: end_of_rollout(program, loop, clock), lambda loop: loop, loop)
            return i, loop, outer[2] + is_done

        begin = (jnp.int32(0), loop, jnp.int32(0))
        _, loop, _ = jax.lax.while_loop(lambda outer: may_go_on(*outer[:2]), one_rollout, begin)
        report = report_of(loop.learned, loop.carry.players, loop.outcome)
        carry = loop.carry._replace(
            state=program.packing.pack(loop.learned.state),
            players=loop.carry.players._replace(log=no_log),
            in_a_row=loop.learned.in_a_row,
        )
        return carry, loop.steps, report


def turn(program: OnPolicyProgram, env: FunctionalEnv, loop: Loop, limits: Limits, i: Array) -> Loop:
    """Returns what the ``i``-th turn of a chunk passes on, apart from the update."""
    config, carry, steps = program.config, loop.carry, loop.steps
    counts, before, t = carry.counts, carry.players, carry.counts.length
    clock = Clock(counts.step, before.episode, limits.progress[i])
    actor = program.algorithm.actor(loop.learned.state)
    action, explorer = program.explorer.act(
        carry.explorer, actor, before.obs, before.ended, nth(carry.key, clock.step), clock
    )
    action = action.astype(steps.action.dtype)
    kept = kept_steps(counts.step, limits.last, program.n_envs)
    players, outcome = play(env, before, action, kept, config.gamma, i)
    put = lambda stores, values: jax.tree.map(lambda s, v: s.at[t].set(v.astype(s.dtype)), stores, values)  # noqa: E731
    steps = Steps(
        put(steps.obs, before.obs),
        put(steps.next_obs, outcome.obs),
        put(steps.action, action),
        put(steps.reward, outcome.reward),
        put(steps.discount, jnp.where(outcome.terminated, 0.0, config.gamma)),
        put(steps.ended, players.ended),
        put(steps.valid, kept),
        put(steps.running_return, players.running_return),
        steps.started,
        steps.carry,
    )
    counts = Counts(counts.step + jnp.sum(kept, dtype=jnp.uint32), t + 1)
    return Loop(carry._replace(explorer=explorer, players=players, counts=counts), steps, loop.learned, outcome)


def end_of_rollout(program: OnPolicyProgram, loop: Loop, clock: Clock) -> Loop:
    """Returns what is passed on after learning from the rollout; the next one begins."""
    carry, batch = loop.carry, rollout_of(loop.steps, loop.carry.counts.length)
    learned, _ = learn(program.algorithm, loop.learned, batch, clock, program.skips)
    steps = loop.steps._replace(started=carry.players.ended, carry=carry.explorer)
    counts = carry.counts._replace(length=jnp.zeros_like(carry.counts.length))
    return loop._replace(carry=carry._replace(counts=counts), steps=steps, learned=learned)


def rollout_of(steps: Steps, length: Any) -> Rollout:
    """Returns the first ``length`` steps as the update takes them."""
    valid = steps.valid & (jnp.arange(len(steps.valid)) < length)[:, None]
    return Rollout(
        steps.obs,
        steps.action,
        steps.reward,
        steps.next_obs,
        steps.discount,
        steps.ended,
        valid,
        steps.running_return,
        steps.started,
        steps.carry,
    )
