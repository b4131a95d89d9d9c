"""Runs on the device: the arguments of the program, and what comes back to the host after a chunk."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from rejeu.core import Clock, Rollout, Transition
from rejeu.envs.base import Step
from rejeu.envs.functional.protocol import FunctionalEnv
from rejeu.envs.functional.vector import joined, split
from rejeu.loops.checks import check_bounds, check_finite, check_obs
from rejeu.loops.device.sharing import filled, mesh_of, over_runs, spread
from rejeu.loops.device.transfer import copies, episodes_of, put_players, unstacked, vector_of
from rejeu.loops.device.turns import Limits, Report
from rejeu.loops.learner import Learner
from rejeu.loops.nonfinite import MAX_SKIPPED, NonFiniteUpdate
from rejeu.loops.packing import Readings
from rejeu.loops.run import Progress, Run

SHARED = ("counts", "valid")
"""Fields that are equal in all runs: counters, and which steps of a rollout count."""


class Machine(ABC):
    """A compiled program with its arguments on the device. Mutable. Abstract: there is one for each kind of learning.

    With several runs their arrays have a leading axis, except for those that all runs share.
    """

    def __init__(
        self, runs: Sequence[Run], learner: Learner, program: Any, size: int, devices: Sequence[jax.Device]
    ) -> None:
        """Takes runs of equal settings in JAX environments, the program that trains them, and devices that may share them.

        ``learner`` keeps the compiled functions, so that later calls find them and they are collected with its agents.
        ``size`` is the number of runs for which the program is compiled, a multiple of that of the devices.
        """
        self.learner, self.program = learner, program
        self.env_arrays, self.env_static = split(vector_of(runs[0]).env)
        self.mesh = mesh_of(size, devices)
        """The devices that share the runs; None if one computes all."""
        self.n = size
        """Number of runs that are computed."""
        self.carry: Any = None
        self.store: Any = None
        """The experience, which is donated to every chunk."""
        self.carries: list[Any] = []
        """The carry after the last chunk by run, on the host apart from large arrays of a single run."""
        self.experience: list[Any] = []
        """What :meth:`fetch` returned after the last chunk, by run."""
        self.report: Any = None
        """Of the last chunk."""
        self.reports: list[Report] = []
        """The same on the host, by run."""
        self.in_a_row: list[int] = []
        """How many of the newest updates before the last chunk were not finite, by run."""

    @property
    def capacity(self) -> int:
        """Turns of a chunk at most."""
        return self.program.capacity

    @abstractmethod
    def carry_of(self, run: Run, progress: float) -> Any:
        """Returns the carry of a run, which may choose its first actions."""

    @abstractmethod
    def begin(self, runs: Sequence[Run]) -> None:
        """Notes where the experience of the runs ends, before they are put onto the device."""

    @abstractmethod
    def store_of(self, run: Run) -> Any:
        """Returns the experience of a run, on the device."""

    @abstractmethod
    def fetch(self, carries: Sequence[Any]) -> list[Any]:
        """Returns the new experience of each run, on the host."""

    @abstractmethod
    def put(self, run: Run, carry: Any, experience: Any) -> None:
        """Puts counters and new experience into a run, which is mutated."""

    @abstractmethod
    def uses_part(self, run: Run, n_turns: int, last: int | None) -> bool:
        """Returns whether an incomplete rollout is learned from if the step ``last`` is reached in so many turns."""

    @abstractmethod
    def batch(self, run: Run, clock: Clock, number: int) -> Transition | Rollout:
        """Returns the batch of a gradient step that was left out in the last turn, the ``number``-th of the turn."""

    def push(self, runs: Sequence[Run], leader: Run, progress: float) -> None:
        """Puts the runs onto the device, with the counters of ``leader``."""
        runs = filled(runs, self.n)
        self.begin(runs)
        self.carries = []
        if self.n == 1:
            self.carry, self.store = self.carry_of(leader, progress), self.store_of(leader)
            return
        self.carry = spread(lambda run: self.carry_of(run, progress), runs, self.mesh)
        self.store = spread(lambda run: jax.device_get(self.store_of(run)), runs, self.mesh)
        self.carry = with_shared(self.carry, lambda: self.carry_of(leader, progress))
        self.store = with_shared(self.store, lambda: self.store_of(leader))

    def call(self, limits: Limits) -> None:
        """Takes a chunk of turns."""
        self.start(limits)
        self.finish()

    def compiled(self, function: Callable[..., Any], **options: Any) -> Any:
        """Returns ``function(program, env, ...)`` compiled for this program, as a function of the other arguments."""
        key = getattr(function, "func", function), self.program, self.env_static, self.n, self.mesh
        if key not in self.learner.programs:
            self.learner.programs[key] = jax.jit(partial(with_env, function, self.program, self.env_static), **options)
        return partial(self.learner.programs[key], self.env_arrays)

    def start(self, limits: Limits) -> None:
        """Starts a chunk of turns, and does not wait for it."""
        self.in_a_row = [int(one.in_a_row) for one in self.carries] or [0] * self.n
        chunk = self.compiled(take_chunk if self.n == 1 else partial(take_chunks, self.mesh), donate_argnums=3)
        self.carry, self.store, self.report = chunk(self.carry, limits, self.store)

    def finish(self) -> None:
        """Waits for the chunk, and copies what it did to the host."""
        counts, self.reports = copies(self.carry.counts), unstacked(copies(self.report), self.n)
        if self.n == 1:  # networks and environments stay on the device; everything else is small
            players = self.carry.players
            small = copies(players._replace(env=None))._replace(env=players.env)
            self.carries = [self.carry._replace(players=small, counts=counts, in_a_row=copies(self.carry.in_a_row))]
        else:
            views = jax.device_get(self.carry._replace(counts=None))
            self.carries = [one._replace(counts=counts) for one in unstacked(views, self.n)]
        self.experience = self.fetch(self.carries)

    def fault(self, which: int) -> bool:
        """Returns whether the last chunk left something that is not finite in a run."""
        carry, report = self.carries[which], self.reports[which]
        stops = report.n_bad > 0 and (not self.program.skips or carry.in_a_row >= MAX_SKIPPED)
        return bool(carry.players.bad or not report.is_finite or stops)

    def pull(self, which: int, run: Run) -> Progress:
        """Puts what the last chunk did into a run, and returns it."""
        carry, report, first_step = self.carries[which], self.reports[which], run.step
        run.step = int(carry.counts.step)
        run.state, run.carry = carry.state, carry.explorer
        put_players(run, carry.players)
        run.n_updates += int(report.n_updates)
        run.monitor.n_skipped += int(report.n_bad)
        if report.n_updates:
            values = [*report.metrics.values(), report.n_bad]
            run.metrics = Readings(tuple(report.metrics), np.array(values, np.float32))  # type: ignore[arg-type]
        self.put(run, carry, self.experience[which])
        if run.step >= run.next_look:
            check_bounds(run, run.obs)
        episodes = episodes_of(run, report.log, first_step, run.step)
        return Progress(run.step, episodes, run.metrics, rollout_ended=bool(report.n_updates))

    def raise_fault(self, which: int, run: Run, limits: Limits) -> NoReturn:
        """Raises the error of a chunk of which nothing was pulled; the run is put before the fault.

        Raises:
            BadEnvironmentError: if a reward or an observation is not finite.
            NonFiniteUpdate: if an update left numbers that are not finite.
        """
        in_a_row, self.n, self.mesh = self.in_a_row[which], 1, None
        for i in range(int(limits.n_turns)):
            one = limits._replace(n_turns=np.int32(1), progress=np.roll(limits.progress, -i))
            self._repeat(run, one, in_a_row)
            if self.carries[0].players.bad:
                self._raise_bad_environment(run)
            if self.fault(0):
                self._raise_bad_update(run, one, in_a_row)
            in_a_row = int(self.carries[0].in_a_row)
            self.pull(0, run)
        raise AssertionError("the chunk was not finite, and its turns are")

    def _repeat(self, run: Run, limits: Limits, in_a_row: int) -> None:
        """Takes a chunk from the state of the run, after so many bad updates in a row."""
        self.push([run], run, float(limits.progress[0]))
        self.carry = self.carry._replace(in_a_row=jnp.int32(in_a_row))
        self.call(limits)

    def _raise_bad_environment(self, run: Run) -> NoReturn:
        """Raises the error of a reward or an observation of the turn that was taken."""
        outcome: Any = self.reports[0].outcome
        run.action = outcome.action
        step = Step(outcome.obs, outcome.reward, outcome.terminated, outcome.truncated, None)
        check_finite(run, step, run.step)
        carry = self.carries[0]
        check_obs(run, carry.players.obs, int(carry.counts.step), "reset returned")
        raise AssertionError("the environment was not finite, and what it returned is")

    def _raise_bad_update(self, run: Run, limits: Limits, in_a_row: int) -> NoReturn:
        """Raises the error of the first bad update of the next turn, with the state before it and its batch."""
        number = 0
        while True:
            self._repeat(run, limits._replace(most_updates=np.int32(number + 1)), in_a_row)
            if self.fault(0):
                break
            number += 1
        skipped = int(self.carries[0].in_a_row) if self.program.skips else 0
        self._repeat(run, limits._replace(most_updates=np.int32(number)), in_a_row)
        carry = self.carries[0]
        clock = Clock(carry.counts.step, carry.players.episode, limits.progress[1])
        batch = self.batch(run, clock, number)
        before = None if self.program.skips else self.carry.state
        raise NonFiniteUpdate(before, batch, clock, skipped, run.n_updates + number)


def with_env(function: Callable[..., Any], program: Any, static: Any, arrays: Any, *arguments: Any) -> Any:
    """Returns the result of ``function(program, env, *arguments)``, given the two parts of the environment."""
    return function(program, joined(static, arrays), *arguments)


def take_chunk(program: Any, env: FunctionalEnv, carry: Any, limits: Limits, store: Any) -> tuple[Any, Any, Report]:
    """Returns carry, experience and report after a chunk."""
    return program.chunk(env, carry, store, limits)


def take_chunks(
    mesh: Mesh | None, program: Any, env: FunctionalEnv, carry: Any, limits: Limits, store: Any
) -> tuple[Any, Any, Report]:
    """Does the same for several runs, which the devices of a mesh share."""
    one = lambda carry, limits, store: program.chunk(env, carry, store, limits)  # noqa: E731
    axes = axes_of(carry), None, axes_of(store)
    return over_runs(one, mesh, axes, (axes[0], axes[2], 0))(carry, limits, store)


def axes_of(tree: Any) -> Any:
    """Returns for each field of a carry or of experience 0, or None if all runs share it."""
    return type(tree)(**{name: None if name in SHARED else 0 for name in tree._fields})


def with_shared(tree: Any, make: Callable[[], Any]) -> Any:
    """Returns a carry or experience of several runs, with the fields that all share from the one that ``make`` returns."""
    names = [name for name in tree._fields if name in SHARED]
    of_one = make() if names else None
    return tree._replace(**{name: getattr(of_one, name) for name in names})
