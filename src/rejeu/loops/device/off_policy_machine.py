"""Off-policy runs on the device: their arguments, and what comes back to the host after a chunk."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rejeu import spaces
from rejeu.algorithms.config import OffPolicyConfig
from rejeu.buffers.device import DeviceReplay, DeviceRing, uploaded, written
from rejeu.buffers.ring import Ring
from rejeu.core import Clock, Transition
from rejeu.envs.base import Step
from rejeu.envs.functional.protocol import FunctionalEnv
from rejeu.loops.checks import check_finite
from rejeu.loops.device.driver import Stops, capacity_of, copies
from rejeu.loops.device.off_policy import Carry, Counts, OffPolicyProgram, Report, choose, chunk, draw, draws
from rejeu.loops.device.transfer import episodes_of, players_of, put_players, rounded_up, stacked, unstacked
from rejeu.loops.device.turns import Limits
from rejeu.loops.learner import Learner
from rejeu.loops.nonfinite import MAX_SKIPPED, NonFiniteUpdate
from rejeu.loops.packing import Readings
from rejeu.loops.run import Progress, Run


class OffPolicyMachine:
    """A :class:`rejeu.loops.device.driver.Machine` for runs with a replay buffer. Mutable."""

    def __init__(self, runs: Sequence[Run], learner: Learner, config: OffPolicyConfig, stops: Stops) -> None:
        """Takes runs of equal settings, whose environments are in JAX."""
        run = runs[0]
        self.n, self.env = len(runs), run.env.env
        self.capacity = min(capacity_of(run.env.n_envs), (run.replay.ring.rows - 1) // 2)
        self.program = OffPolicyProgram(
            learner.algorithm,
            learner.explorer,
            config,
            replay_of(run, config),
            learner.packing,
            self.capacity,
            learner.skips,
            stops.at_episodes,
        )
        self.learn_from = np.uint32(run.learn_from)
        self.carry: Carry
        self.ring: DeviceRing
        self.report: Report
        self.carries: list[Any] = []

    def push(self, runs: Sequence[Run], progress: float) -> None:
        carries = [carry_of(run) for run in runs]
        for i, run in enumerate(runs):
            if run.action is None:
                run.action = np.asarray(first_action(self.program, self.env, carries[i], np.float32(progress)))
                carries[i] = carries[i]._replace(action=jnp.array(run.action))
        self.carry = stacked(carries)._replace(counts=carries[0].counts) if self.n > 1 else carries[0]
        self.ring = stacked([uploaded(self.program.replay, run.replay.ring) for run in runs])

    def call(self, limits: Limits) -> None:
        function = take_chunk if self.n == 1 else partial(take_chunks)
        self.carry, self.ring, self.report = function(
            (self.program, self.env, self.carry, self.learn_from, limits), self.ring
        )
        # The state stays on the device; everything else that is small comes to the host at once.
        small = self.carry._replace(state=None, players=self.carry.players._replace(env=None))
        small, report = copies((small, self.report))
        self.carries, self.reports = unstacked(small, 1), unstacked(report, self.n)
        if self.n > 1:
            self.carries = unstacked(small._replace(counts=None), self.n)
            self.carries = [one._replace(counts=small.counts) for one in self.carries]

    def fault(self, which: int) -> bool:
        report, skips = self.reports[which], self.program.skips
        carry = self.carries[which]
        return bool(
            carry.players.bad or not report.is_finite or (report.n_bad and (not skips or carry.in_a_row >= MAX_SKIPPED))
        )

    def pull(self, which: int, run: Run, n_turns: int, last: int | None) -> Progress:
        carry, report = self.carries[which], self.reports[which]
        first_step, ring = run.step, unstacked(self.ring, self.n)[which]
        run.step, counts = int(carry.counts.step), carry.counts
        run.state = unstacked(self.carry.state, self.n)[which]
        run.carry = unstacked(self.carry.explorer, self.n)[which]
        run.action, run.owed, run.steps_since_update = carry.action, int(counts.owed), int(counts.since_update)
        put_players(run, carry.players, unstacked(self.carry.players.env, self.n)[which])
        run.n_updates += int(counts.n_updates)
        run.monitor.n_skipped += int(report.n_bad)
        if counts.n_updates:
            run.metrics = Readings.of(
                {name: jnp.asarray(value) for name, value in report.metrics.items()}, report.n_bad
            )
        download(self.program.replay, ring, run.replay.ring)
        episodes = episodes_of(run, report.log, first_step, run.step)
        return Progress(run.step, episodes, run.metrics, rollout_ended=bool(counts.n_updates))

    def raise_fault(self, run: Run, limits: Limits) -> NoReturn:
        alone = OffPolicyMachine.__new__(OffPolicyMachine)
        alone.n, alone.env, alone.capacity, alone.program = 1, self.env, self.capacity, self.program
        alone.learn_from = self.learn_from
        for i in range(int(limits.n_turns)):
            progress = np.roll(limits.progress, -i)
            one = limits._replace(n_turns=np.int32(1), progress=progress)
            alone.push([run], float(progress[0]))
            alone.call(one)
            if alone.carries[0].players.bad:
                raise_bad_step(run, alone.reports[0].outcome)
            if alone.fault(0):
                alone.raise_bad_update(run, one)
            alone.pull(0, run, 1, None)
        raise AssertionError("the chunk was not finite, and its turns are")

    def raise_bad_update(self, run: Run, limits: Limits) -> NoReturn:
        """Raises the error of the first bad update of a turn, with the state before it and its batch."""
        in_a_row = int(self.carries[0].in_a_row) if self.program.skips else 0
        for u in range(int(self.carries[0].counts.n_updates)):
            self.push([run], float(limits.progress[0]))
            self.call(limits._replace(most_updates=np.int32(u + 1)))
            if self.fault(0):
                break
        self.push([run], float(limits.progress[0]))
        self.call(limits._replace(most_updates=np.int32(u)))
        counts, players = self.carries[0].counts, self.carries[0].players
        clock = Clock(counts.step, players.episode, limits.progress[1])
        batch = copies(drawn(self.program.replay, self.env, self.ring, self.carry.key, clock.step, np.uint32(u + 1)))
        raise NonFiniteUpdate(None if self.program.skips else self.carry.state, batch, clock, in_a_row)


@eqx.filter_jit(donate="all-except-first")
def take_chunk(kept: tuple[Any, ...], ring: DeviceRing) -> tuple[Carry, DeviceRing, Report]:
    """Returns what :func:`rejeu.loops.device.off_policy.chunk` does; only the replay buffer is donated."""
    program, env, carry, learn_from, limits = kept
    return chunk(program, env, carry, ring, learn_from, limits)


@eqx.filter_jit(donate="all-except-first")
def take_chunks(kept: tuple[Any, ...], ring: DeviceRing) -> tuple[Carry, DeviceRing, Report]:
    """Does the same for several runs, whose arrays have a leading axis, except for their counters."""
    program, env, carry, learn_from, limits = kept
    axes = seed_axes(program)
    one = lambda carry, ring: chunk(program, env, carry, ring, learn_from, limits)  # noqa: E731
    return jax.vmap(one, in_axes=(axes, 0), out_axes=(axes, 0, 0))(carry, ring)


def seed_axes(program: OffPolicyProgram) -> Carry:
    """Returns which parts of a carry have an axis of runs: all but the counters."""
    return Carry(0, 0, 0, 0, 0, Counts(None, None, None, None), 0)  # type: ignore[arg-type]


@eqx.filter_jit
def first_action(program: OffPolicyProgram, env: FunctionalEnv, carry: Carry, progress: Any) -> Array:
    """Returns the first actions of a run."""
    carry = carry._replace(state=program.packing.unpack(carry.state))
    clock = Clock(carry.counts.step, carry.players.episode, progress)
    return choose(program, env, carry, clock).action


@eqx.filter_jit
def drawn(
    replay: DeviceReplay, env: FunctionalEnv, ring: DeviceRing, key: Array, step: Array, number: Any
) -> Transition:
    """Returns the batch of a gradient step of a turn."""
    return draw(replay, env, ring, jax.random.fold_in(draws(key, step), number))


@eqx.filter_jit
def rows_from(replay: DeviceReplay, ring: DeviceRing, first: Any, size: int) -> dict[str, Any]:
    """Returns rows of the ring; see :func:`rejeu.buffers.device.written`."""
    return written(replay, ring, first, size)


def download(replay: DeviceReplay, ring: DeviceRing, host: Ring) -> None:
    """Writes the rows that are new on the device into the ring of the host."""
    head = np.asarray(ring.head).astype(np.int64)
    size = rounded_up(int((head - host.head).max()) + 1, replay.rows)
    host.write(head, jax.device_get(rows_from(replay, ring, host.head.astype(np.int32), size)))


def replay_of(run: Run, config: OffPolicyConfig) -> DeviceReplay:
    """Returns how batches are drawn on the device from the replay buffer of a run."""
    buffer, hindsight = run.replay, config.hindsight
    ring = buffer.ring
    paths = [leaf.path for leaf in ring.obs_leaves]
    goals: dict[str, Any] = {} if hindsight is None else {
        "strategy": hindsight.goal_selection_strategy,
        "n_sampled_goal": hindsight.n_sampled_goal,
        "achieved": paths.index("achieved_goal"),
        "desired": paths.index("desired_goal"),
    }  # fmt: skip
    return DeviceReplay(
        ring.rows,
        ring.n_envs,
        ring.obs_structure,
        config.gamma,
        config.batch_size,
        config.n_steps,
        buffer.each_reward,
        **goals,
    )


def carry_of(run: Run) -> Carry:
    """Returns the carry of a run; without actions, if none were chosen yet, random ones stand for their shape."""
    action = run.action
    if action is None:
        action = spaces.random_action(run.env.action_space, run.env.n_envs, np.random.default_rng(0))
    counts = Counts(
        jnp.uint32(run.step), jnp.int32(run.owed), jnp.int32(run.steps_since_update), jnp.int32(0)
    )  # fmt: skip
    return Carry(
        state=run.state,
        key=jnp.asarray(run.key),
        explorer=jax.tree.map(jnp.asarray, run.carry),
        action=jnp.array(action),
        players=players_of(run),
        counts=counts,
        in_a_row=jnp.int32(0),
    )


def raise_bad_step(run: Run, outcome: Any) -> NoReturn:
    """Raises the error of a step whose reward or observation is not finite."""
    step = Step(outcome.obs, outcome.reward, outcome.terminated, outcome.truncated, None)
    check_finite(run, step, run.step)
    raise AssertionError("the step is finite")
