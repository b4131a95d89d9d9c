"""Runs on the device: the arguments of the program, and what comes back to the host after a chunk.

Several runs are the leading axis of all arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rejeu.core.algorithm import Clock, PyTree, Scalar
from rejeu.core.xla import for_runs
from rejeu.envs.base import success_by
from rejeu.envs.functional.protocol import FunctionalEnv
from rejeu.envs.functional.vector import JaxVector, joined, split
from rejeu.envs.masks import MaskedVector
from rejeu.training.checks import check_bounds
from rejeu.training.compiled.program import Carry, ChunkReport, EpisodeLog, EpisodeState, Limits, Program
from rejeu.training.finite import MAX_SKIPPED
from rejeu.training.learner import Learner, Readings
from rejeu.training.run import Episode, Progress, Run

SHARED = ("counts", "valid")
"""Fields that are equal in all runs: counters, and which steps of a rollout count."""


class DeviceTrainer:
    """Runs the compiled program and copies its results into each host ``Run``. Mutable.

    Experience stays on the device until ``Run.replay`` is read.
    """

    def __init__(self, program: Any, runs: Sequence[Run], learner: Learner, hyper: Sequence[dict[str, float]]) -> None:
        """Takes runs of equal settings in JAX environments.

        Args:
            program: a :class:`Program`.
            runs: mutated.
            learner: keeps the compiled functions, so that later calls find them and they are collected with its agents.
            hyper: hyperparameters that differ, by run.
        """
        self.program, self.runs, self.learner, self.hyper = program, runs, learner, hyper
        self.env_arrays, self.env_static = split(vector_of(runs[0]).env)
        self.carry: PyTree = None
        """On the device. If there are several runs, arrays have a leading axis, except ``SHARED``."""
        self.experience: PyTree = None
        """The replay buffers or rollouts, on the device, likewise."""
        self.report: PyTree = None
        """Of the chunk under way, on the device; None if there is none."""
        self.carries: list[Carry] = []
        """The carry after the last chunk by run, on the host apart from large arrays of a single run."""
        self.reports: list[ChunkReport] = []
        """Of the last chunk by run, on the host."""

    def carry_of(self, run_number: int, progress: float) -> Carry:
        """Returns the carry of a run, which may choose its first actions."""
        run = self.runs[run_number]
        carry = Carry(
            state=run.state,
            key=jnp.asarray(run.key),
            explorer=jax.tree.map(jnp.asarray, run.carry),
            action=self.program.action_of(run),
            episodes=episodes_of(run),
            counts=self.program.counts_of(run),
            in_a_row=jnp.int32(0),
            hyper={name: jnp.float32(value) for name, value in self.hyper[run_number].items()},
        )
        if carry.action is not None and run.action is None:
            run.action = np.array(self.compiled(first_action)(carry, np.float32(progress)))
            carry = carry._replace(action=jnp.array(run.action))
        return carry

    def push(self, progress: float, leader: int) -> None:
        """Puts the runs onto the device, with the counters of the run ``leader``."""
        carries = [self.carry_of(i, progress) for i in range(len(self.runs))]
        if len(self.runs) == 1:
            self.carry, self.experience = carries[0], self.program.upload(self.runs[0])
        else:
            stores = [jax.device_get(self.program.upload(run)) for run in self.runs]
            self.carry = with_shared(stacked(carries), carries[leader])
            self.experience = with_shared(stacked(stores), stores[leader])

    def compiled(self, function: Callable[..., Any], **options: Any) -> Any:
        """Returns ``function(program, env, ...)`` compiled for this program, as a function of the other arguments."""
        key = function, self.program, self.env_static, len(self.runs)
        if key not in self.learner.programs:
            self.learner.programs[key] = jax.jit(partial(with_env, function, self.program, self.env_static), **options)
        return partial(self.learner.programs[key], self.env_arrays)

    def take(self, limits: Limits) -> None:
        """Takes a chunk of turns, and copies what it did to the host, apart from experience."""
        chunk = self.compiled(take_chunk, donate_argnums=3)
        self.carry, self.experience, self.report = chunk(self.carry, limits, self.experience)
        self.finish()

    def finish(self) -> None:
        """Waits for the chunk, and copies what it did to the host, apart from experience."""
        carry, counts, n = self.carry, copies(self.carry.counts), len(self.runs)
        self.reports = unstacked(copies(self.report), n)
        if n == 1:  # networks and environments stay on the device; everything else is small
            small = copies((carry.episodes._replace(env=None), carry.action, carry.in_a_row))
            episodes = small[0]._replace(env=carry.episodes.env)
            self.carries = [carry._replace(episodes=episodes, action=small[1], counts=counts, in_a_row=small[2])]
        else:
            views = unstacked(jax.device_get(carry._replace(counts=None)), n)
            self.carries = [view._replace(counts=counts) for view in views]

    def pull(self, active: Iterable[int]) -> list[Progress | None]:
        """Puts what the chunk did into the runs ``active``, and returns it by run; experience follows when it is read."""
        self.report, pulled = None, list[Progress | None]([None] * len(self.runs))
        for i in active:
            pulled[i] = self._pull(i)
        return pulled

    def _pull(self, run_number: int) -> Progress:
        run, carry, report = self.runs[run_number], self.carries[run_number], self.reports[run_number]
        first_step, run.step = run.step, int(carry.counts.step)
        run.state, run.carry = carry.state, carry.explorer
        put_episodes(run, carry.episodes)
        run.n_updates += int(report.n_updates)
        run.monitor.n_skipped += int(report.n_bad)
        if report.n_updates:
            values = [*report.metrics.values(), report.n_bad]
            run.metrics = Readings(tuple(report.metrics), np.array(values, np.float32))  # type: ignore[arg-type]
        self.program.pull_counts(run, carry)
        run.fetch = partial(self._fetch, run_number)
        if run.step >= run.next_look:
            check_bounds(run, run.obs)
        episodes = episodes_in(run, report.log, first_step)
        return Progress(run.step, episodes, run.metrics, rollout_ended=bool(report.n_updates))

    def fault(self, run_number: int) -> bool:
        """Returns whether the last chunk left something that is not finite in a run."""
        report = self.reports[run_number]
        stops = report.n_bad > 0 and (not self.program.skips or self.carries[run_number].in_a_row >= MAX_SKIPPED)
        return bool(report.nonfinite_env or not report.is_finite or stops)

    def _fetch(self, run_number: int) -> None:
        """Copies the experience of a run to its buffer on the host."""
        experience = self.experience if len(self.runs) == 1 else of_run(self.experience, run_number)
        self.program.download(self.runs[run_number], experience, copies(self.carry.counts))

    def close(self, active: Iterable[int]) -> None:
        """Copies what is on the device to the runs, also a chunk during which training was interrupted."""
        if self.report is not None:
            self.finish()
            self.pull(active)
        for run in self.runs:
            run.copy_replay()
            run.state, run.carry = jax.tree.map(jnp.array, (run.state, run.carry))  # views of arrays of all runs


def with_env(function: Callable[..., Any], program: Any, static: PyTree, arrays: PyTree, *arguments: PyTree) -> PyTree:
    """Returns the result of ``function(program, env, *arguments)``, given the two parts of the environment."""
    return function(program, joined(static, arrays), *arguments)


def take_chunk(
    program: Program, env: FunctionalEnv, carry: PyTree, limits: Limits, experience: PyTree
) -> tuple[PyTree, PyTree, ChunkReport]:
    """Returns carry, experience and report after a chunk, of several runs if there is an axis of them."""
    take = lambda carry, limits, experience: program.chunk(env, carry, experience, limits)  # noqa: E731
    if np.ndim(carry.in_a_row) == 0:
        return take(carry, limits, experience)
    axes = axes_of(carry), None, axes_of(experience)
    return jax.vmap(for_runs(take, len(carry.in_a_row)), axes, (axes[0], axes[2], 0))(carry, limits, experience)


def first_action(program: Program, env: FunctionalEnv, carry: Carry, progress: Scalar) -> jax.Array | None:
    """Returns the first actions of a run."""
    program = program.with_hyperparameters(carry.hyper)
    clock = Clock(carry.counts.step, carry.episodes.n_finished, progress)
    return program.choose(env, carry, program.packing.unpack(carry.state), clock).action  # type: ignore[attr-defined]


def axes_of(tree: PyTree) -> PyTree:
    """Returns for each field of a carry or of experience 0, or None if all runs share it."""
    return type(tree)(**{name: None if name in SHARED else 0 for name in tree._fields})


def of_run(tree: PyTree, i: int) -> PyTree:
    """Returns the experience of one of several runs."""
    parts = {name: jax.tree.map(lambda leaf: leaf[i], getattr(tree, name)) for name in {*tree._fields} - {*SHARED}}
    return tree._replace(**parts)


def with_shared(tree: PyTree, of_one: PyTree) -> PyTree:
    """Returns a carry or experience of several runs, with the fields that all share from that of one."""
    return tree._replace(**{name: getattr(of_one, name) for name in tree._fields if name in SHARED})


def vector_of(run: Run) -> JaxVector:
    """Returns the environments in JAX of a run, those behind masks if it has masks."""
    vector = run.env.inner if isinstance(run.env, MaskedVector) else run.env
    assert isinstance(vector, JaxVector), vector
    return vector


def episodes_of(run: Run) -> EpisodeState:
    """Returns the environments of a run and their episodes."""
    return EpisodeState(
        env=vector_of(run).state,
        obs=jax.tree.map(jnp.array, run.obs),
        ended=jnp.array(run.ended),
        episode_return=jnp.array(run.episode_return, jnp.float32),
        length=jnp.array(run.episode_length, jnp.int32),
        running_return=jnp.array(run.running_return, jnp.float32),
        n_finished=jnp.uint32(run.episode),
    )


def put_episodes(run: Run, episodes: PyTree) -> None:
    """Puts environments and episodes into a run, as the host's loops leave them.

    Args:
        run: mutated.
        episodes: :class:`EpisodeState` with arrays on the host, apart from the state of the environments.
    """
    vector_of(run).state = episodes.env
    run.obs, run.ended = episodes.obs, episodes.ended
    run.episode_return = episodes.episode_return.astype(np.float64)
    run.episode_length = episodes.length.astype(np.int64)
    run.running_return = episodes.running_return
    run.episode = int(episodes.n_finished)


def episodes_in(run: Run, log: EpisodeLog, first_step: int) -> list[Episode]:
    """Returns the episodes that ended in a chunk, in the order in which they ended.

    Args:
        run: whose environments and success threshold count.
        log: on the host.
        first_step: total environment steps before the chunk.
    """
    threshold = run.env.reward_threshold if run.success_threshold is None else run.success_threshold
    episodes = []
    for turn, env in zip(*(indices.tolist() for indices in np.nonzero(log.length)), strict=True):
        value = float(log.episode_return[turn, env])
        success = success_by(float(log.success[turn, env]), value, threshold)
        step = first_step + (turn + 1) * run.env.n_envs
        episodes.append(Episode(step, env, value, int(log.length[turn, env]), success, run.seconds["total"]))
    return episodes


def stacked(trees: Sequence[PyTree]) -> PyTree:
    """Returns trees of equal structure as one on the device, whose leaves have a leading axis."""

    def joined(*leaves: Array) -> jax.Array:
        on_host = all(isinstance(leaf, np.ndarray) for leaf in leaves)
        return jnp.array(np.stack(leaves)) if on_host else jnp.stack(leaves)

    return jax.tree.map(joined, *trees)


def unstacked(tree: PyTree, n: int) -> list[PyTree]:
    """Returns the ``n`` trees of which :func:`stacked` made one; a single one has no leading axis."""
    return [tree] if n == 1 else [jax.tree.map(lambda leaf, i=i: leaf[i], tree) for i in range(n)]


def copies(tree: PyTree) -> PyTree:
    """Returns copies of arrays on the host."""
    return jax.tree.map(np.array, jax.device_get(tree))
