"""Several off-policy runs in environments on the host: each has its own, and one call acts and updates for all.

A turn is that of :func:`rejeu.loops.off_policy.off_policy` for each run, with the run's own random numbers; only the calls of
compiled code are one for all runs. As on the device, callbacks are served between chunks of turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, NoReturn

import jax
import numpy as np

from rejeu.algorithms.config import OffPolicyConfig
from rejeu.core import Clock
from rejeu.errors import NonFiniteError
from rejeu.loops.checks import check_step, checked_reset
from rejeu.loops.device.driver import MAX_TURNS
from rejeu.loops.device.turns import NO_LIMIT, Limits
from rejeu.loops.learner import Learner, is_finite
from rejeu.loops.nonfinite import MAX_SKIPPED, NonFiniteUpdate, gradient_steps
from rejeu.loops.off_policy import batch_shapes, due
from rejeu.loops.packing import PackedState, Readings
from rejeu.loops.run import Episode, Progress, Run, clock_of, record_step
from rejeu.spaces import action_scaler, random_action


class Call(NamedTuple):
    """A call that changed the states, with the arguments of all runs."""

    is_update: bool
    """Whether it was an update, rather than one of the statistics."""
    arguments: tuple[Any, ...]


class HostMachine:
    """Runs with replay buffers and environments on the host; see :class:`rejeu.loops.device.machine.Machine`. Mutable."""

    capacity = MAX_TURNS

    def __init__(self, learner: Learner, config: OffPolicyConfig, active: Sequence[int]) -> None:
        """Takes the algorithm, its hyperparameters, and the indices of the runs that are trained, which may change."""
        self.learner, self.config, self.active = learner, config, active
        self.runs: list[Run] = []
        """The runs that are trained."""
        self.order: list[int] = []
        """Their indices."""
        self.several = learner.several()
        self.state: PackedState = []
        """Packed states of all runs, with a leading axis."""
        self.carry: Any = None
        """The state of exploration of all runs, likewise."""
        self.before: list[np.ndarray] = []
        """Those before the chunk, on the host."""
        self.after: list[np.ndarray] = []
        """Those after it, likewise."""
        self.calls: list[Call] = []
        self.episodes: list[list[Episode]] = []
        self.readings: Readings | None = None
        self.n_bad: np.ndarray = np.zeros(0)
        """Bad updates of the last chunk, by run."""
        self.in_a_row: np.ndarray = np.zeros(0, np.int64)

    def uses_part(self, run: Run, n_turns: int, last: int | None) -> bool:
        """Returns False: there are no rollouts."""
        return False

    def push(self, runs: Sequence[Run], leader: Run, progress: float) -> None:
        """Stacks the states of the runs, and chooses first actions."""
        self.order = [*self.active]
        self.runs = runs = [runs[i] for i in self.order]
        self.state = [jax.numpy.asarray(part) for part in stacked([run.state for run in runs])]
        self.carry = stacked([run.carry for run in runs])
        self.in_a_row = np.zeros(len(runs), np.int64)
        clocks = [clock_of(run, progress) for run in runs]
        if any(run.action is None for run in runs):
            chosen = self.choose(clocks)
            for run, action in zip(runs, np.asarray(chosen), strict=True):
                run.action = np.array(action) if run.action is None else run.action

    def call(self, limits: Limits) -> None:
        """Takes a chunk of turns, which ends early if an update is bad."""
        found: list[Readings] = []
        self.before, self.calls = [np.array(part) for part in self.state], []
        self.episodes = [[] for _ in self.runs]
        try:
            self.take(limits, found)
        except NonFiniteError:  # of an action
            if is_finite(self.state):
                raise
        finally:
            self.fetch()
        bad = [n_bad(one) for one in found]
        self.n_bad = np.sum(bad, axis=0) if bad else np.zeros(len(self.runs), np.int64)
        for one in bad:
            self.in_a_row = np.where(one > 0, self.in_a_row + one, 0)
        self.readings = found[-1] if found else None

    def take(self, limits: Limits, found: list[Readings]) -> None:
        """Takes the turns of a chunk, and adds what the updates reported to ``found``."""
        n_read = 0
        for i in range(int(limits.n_turns)):
            n_done = len(found)  # those are done, since the actions came after them
            found += self.turn(limits, float(limits.progress[i + 1]))
            n_done = n_done if self.config.overlap else len(found)
            if not self.learner.skips and any(n_bad(one).any() for one in found[n_read:n_done]):
                return
            n_read = n_done

    def turn(self, limits: Limits, progress: float) -> list[Readings]:
        """Takes one turn of all runs, and returns what the updates reported."""
        runs, config, n_envs = self.runs, self.config, self.runs[0].env.n_envs
        last = None if limits.last == NO_LIMIT else int(limits.last)
        ended = [self.step(i, run, last) for i, run in enumerate(runs)]
        if self.learner.observe is not None:
            seen, returns = stacked([run.obs for run in runs]), stacked([run.running_return for run in runs])
            self.calls.append(Call(False, (seen, returns)))
            self.state = self.several.observe(self.state, seen, returns)
        (n_updates,) = {due(run, config, kept, n) for run, (kept, n) in zip(runs, ended, strict=True)}
        clocks = [clock_of(run, progress) for run in runs]
        chosen = self.choose(clocks) if config.overlap else None
        readings, clock = [], Clock(*stacked(clocks))
        drawn = [[run.replay.draw(run.rng, shape, progress) for run in runs]
                 for shape in batch_shapes(n_updates, config, n_envs)]  # fmt: skip
        for run in runs:
            run.replay.update_priorities(run.td_errors)
            run.td_errors = []
            run.n_updates += n_updates
        for samples in drawn:
            batch = stacked([one for one, _ in samples])
            self.calls.append(Call(True, (batch, clock)))
            self.state, reading, td_error = self.several.update(self.state, batch, clock)
            readings.append(reading)
            if td_error is not None:
                for run, (_, draw), error in zip(runs, samples, td_error, strict=True):
                    run.td_errors.append((draw, error))
        chosen = self.choose(clocks) if chosen is None else chosen
        for run, action in zip(runs, np.asarray(chosen), strict=True):
            run.action = action
        return readings

    def step(self, which: int, run: Run, last: int | None) -> tuple[int, int]:
        """Steps the environments of a run, stores the step, and returns how many steps and ended episodes count."""
        n_envs = run.env.n_envs
        n_kept = n_envs if last is None else min(n_envs, last - run.step)
        kept = None if n_kept == n_envs else np.arange(n_kept)
        assert run.action is not None
        step = run.env.step(action_scaler(run.env.action_space)(run.action))
        check_step(run, step)
        if self.learner.observe is not None:
            run.running_return = np.where(run.ended, 0.0, self.config.gamma * run.running_return) + step.reward
        run.replay.add(run.action, step.reward, step.terminated, step.obs, kept)
        run.step += n_kept
        episodes = record_step(run, step, None if kept is None else np.arange(n_envs) < n_kept)
        self.episodes[which] += episodes
        run.obs = step.obs
        if np.count_nonzero(run.ended):
            run.obs = checked_reset(run, run.ended)
            run.replay.begin(run.obs, np.flatnonzero(run.ended))
        return n_kept, len(episodes)

    def choose(self, clocks: Sequence[Clock]) -> Any:
        """Returns the next actions of all runs; see :func:`rejeu.loops.off_policy.choose`."""
        runs = self.runs
        if runs[0].step < self.config.learning_starts:
            return [random_action(run.env.action_space, run.env.n_envs, run.rng) for run in runs]
        given = zip(*((run.obs, run.ended, run.key) for run in runs), strict=True)
        obs, ended, keys = (stacked(one) for one in given)
        chosen, self.carry = self.several.act(self.state, self.carry, obs, ended, keys, Clock(*stacked(clocks)))
        return chosen

    def fault(self, which: int) -> bool:
        """Returns whether the last chunk left something that is not finite in a run."""
        which = self.order.index(which)
        if self.learner.skips:
            return bool(self.in_a_row[which] >= MAX_SKIPPED)
        return bool(self.n_bad[which] or not is_finite(self.state_of(which)))

    def fetch(self) -> None:
        """Copies the states to the host, and gives each run its own, if that is finite, and that of its exploration."""
        self.after = [np.array(part) for part in self.state]
        carry = jax.device_get(self.carry)
        for i, run in enumerate(self.runs):
            run.state = state if is_finite(state := self.state_of(i)) else run.state
            run.carry = jax.tree.map(lambda part, i=i: np.array(part[i]), carry)

    def state_of(self, which: int) -> PackedState:
        """Returns the packed state of a run after the chunk by its place among those that are trained."""
        return [part[which] for part in self.after]

    def pull(self, which: int, run: Run) -> Progress:
        """Puts what the last chunk did into a run, and returns it."""
        which = self.order.index(which)
        run.monitor.n_skipped += int(self.n_bad[which]) if self.learner.skips else 0
        if self.readings is not None:
            run.metrics = Readings(self.readings.names, self.readings.vector[which])
        return Progress(run.step, self.episodes[which], run.metrics, rollout_ended=self.readings is not None)

    def raise_fault(self, which: int, run: Run, limits: Limits) -> NoReturn:
        """Raises the error of the first bad update of the last chunk, with the state before it and its batch."""
        which = self.order.index(which)
        state, learner = [jax.numpy.array(part[which]) for part in self.before], self.learner
        rewards = [call.arguments[0].reward[which] for call in self.calls if call.is_update]
        n_updates = run.n_updates - sum(gradient_steps(reward) for reward in rewards)
        for call in self.calls:
            own = jax.tree.map(lambda part: part[which], call.arguments)
            kept = learner.copy(state)
            if call.is_update:
                state, readings, _ = learner.update(state, *own)
                if readings.n_bad or not is_finite(state):
                    batch, clock = own
                    in_a_row = int(self.in_a_row[which])
                    raise NonFiniteUpdate(None if learner.skips else kept, batch, clock, in_a_row, n_updates)
                n_updates += gradient_steps(own[0].reward)
            else:
                assert learner.observe is not None
                state = learner.observe(state, *own)
        raise AssertionError("the chunk was not finite, and its updates are")


def n_bad(readings: Readings) -> np.ndarray:
    """Returns the number of bad gradient steps of an update of several runs, ``int64 (n_runs,)``; waits for the device."""
    return np.asarray(readings.vector)[:, -1].astype(np.int64)


def stacked(trees: Sequence[Any]) -> Any:
    """Returns trees of equal structure as one, whose leaves have a leading axis, on the host."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)
