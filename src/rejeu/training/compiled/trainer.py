"""Runs on the device: the arguments of the program, what comes back to the host after a chunk, and which devices share it.

Several runs are the leading axis of all arrays. Each of several devices computes an equal number of them, apart from the
others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NoReturn, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from rejeu.core.algorithm import Clock, PyTree
from rejeu.core.xla import for_runs
from rejeu.envs.base import Step, success_by
from rejeu.envs.functional.protocol import FunctionalEnv
from rejeu.envs.functional.vector import JaxVector, joined, split
from rejeu.envs.masks import functional_vector
from rejeu.training.checks import check_bounds, check_finite, check_obs
from rejeu.training.compiled.program import Carry, ChunkReport, EpisodeLog, EpisodeState, Limits, Program
from rejeu.training.finite import MAX_SKIPPED, NonFiniteUpdate
from rejeu.training.learner import Learner, Readings
from rejeu.training.run import Episode, Progress, Run

T = TypeVar("T")
RUNS = "runs"
"""Name of the axis of runs."""
MOST_ON_CPU = 8
"""Runs that a CPU device computes at once at most: the layers of more do not fit into the cache of a core."""
SHARED = ("counts", "valid")
"""Fields that are equal in all runs: counters, and which steps of a rollout count."""


@dataclass
class RunGroup:
    """Runs that one call of the program trains. If there are several, arrays have a leading axis, except ``SHARED``."""

    carry: Any
    experience: Any
    """The replay buffers or rollouts, on the device."""
    report: Any = None
    """Of the last chunk, on the device."""
    before: tuple[Any, Callable[[Any], Any]] | None = None
    """The carry before the last chunk, and the function that puts the experience back."""


class DeviceTrainer:
    """Runs the compiled program and copies its results into each host ``Run``. Mutable.

    Experience stays on the device until ``Run.replay`` is read.
    """

    def __init__(
        self,
        program: Any,
        runs: Sequence[Run],
        learner: Learner,
        size: int = 1,
        devices: Sequence[jax.Device] = (),
        hyper: Sequence[dict[str, float]] | None = None,
    ) -> None:
        """Takes runs of equal settings in JAX environments.

        Args:
            program: a :class:`Program`.
            runs: mutated.
            learner: keeps the compiled functions, so that later calls find them and they are collected with its agents.
            size: the number of runs for which the program is compiled, a multiple of that of the devices that share them.
                More runs are trained in groups, which take their chunks one after another.
            devices: which share several runs.
            hyper: hyperparameters that differ, by run.
        """
        self.program, self.runs, self.learner, self.size = program, runs, learner, size
        self.env_arrays, self.env_static = split(vector_of(runs[0]).env)
        self.mesh: Mesh | None = mesh_of(size, devices)
        """The devices that share the runs; None if one computes all."""
        self.hyper = {id(run): one for run, one in zip(runs, hyper or [{}] * len(runs), strict=True)}
        self.groups: list[RunGroup] = []
        self.carries: dict[int, Carry] = {}
        """The carry after the last chunk by run, on the host apart from large arrays of a single run."""
        self.reports: dict[int, ChunkReport] = {}
        """Of the last chunk by run, on the host."""

    def carry_of(self, run: Run, progress: float) -> Carry:
        """Returns the carry of a run, which may choose its first actions."""
        carry = Carry(
            state=run.state,
            key=jnp.asarray(run.key),
            explorer=jax.tree.map(jnp.asarray, run.carry),
            action=self.program.action_of(run),
            episodes=episodes_of(run),
            counts=self.program.counts_of(run),
            in_a_row=jnp.int32(0),
            hyper={name: jnp.float32(value) for name, value in self.hyper[id(run)].items()},
        )
        if carry.action is not None and run.action is None:
            run.action = np.array(self.compiled(first_action)(carry, np.float32(progress)))
            carry = carry._replace(action=jnp.array(run.action))
        return carry

    def push(self, progress: float, leader: Run) -> None:
        """Puts the runs onto the device, with the counters of ``leader``."""
        parts = [self.runs[i : i + self.size] for i in range(0, len(self.runs), self.size)]
        self.groups = [self._pushed(filled(part, self.size), leader, progress) for part in parts]
        self.carries = {}

    def _pushed(self, runs: Sequence[Run], leader: Run, progress: float) -> RunGroup:
        if self.size == 1:
            experience = self.program.uploaded(runs[0])
            return RunGroup(self.carry_of(runs[0], progress), experience)
        experience = spread(lambda run: jax.device_get(self.program.uploaded(run)), runs, self.mesh)
        experience = with_shared(experience, lambda: self.program.uploaded(leader))
        carry = spread(lambda run: self.carry_of(run, progress), runs, self.mesh)
        return RunGroup(with_shared(carry, lambda: self.carry_of(leader, progress)), experience)

    def compiled(self, function: Callable[..., Any], **options: Any) -> Any:
        """Returns ``function(program, env, ...)`` compiled for this program, as a function of the other arguments."""
        given = getattr(function, "args", ())
        key = getattr(function, "func", function), given, self.program, self.env_static, self.size
        if key not in self.learner.programs:
            self.learner.programs[key] = jax.jit(partial(with_env, function, self.program, self.env_static), **options)
        return partial(self.learner.programs[key], self.env_arrays)

    def take(self, limits: Limits, active: Iterable[int]) -> None:
        """Takes a chunk of turns in the groups of the runs ``active``; while one is copied to the host, the next computes."""
        busy = sorted({i // self.size for i in active})
        try:
            for group in (self.groups[g] for g in busy):
                self.start(group, limits)
            for g in busy:
                self.finish(g)
        except BaseException:  # such as KeyboardInterrupt: the runs are still before the chunk
            self.undo()
            raise

    def start(self, group: RunGroup, limits: Limits) -> None:
        """Starts a chunk of turns, and does not wait for it."""
        before, n_rows, options = group.experience, self.program.rows_changed(int(limits.n_turns)), {}
        back: Callable[[Any], Any] = lambda experience: before  # noqa: E731
        if n_rows is not None:
            rows = self.compiled(partial(next_rows, self.mesh, self.size, n_rows))(group.experience)
            put_back = self.compiled(partial(with_rows, self.mesh, self.size), donate_argnums=1)
            back, options = lambda experience: put_back(experience, rows), {"donate_argnums": 3}
        chunk = self.compiled(partial(take_chunk, self.mesh, self.size), **options)
        carry = group.carry
        group.carry, group.experience, group.report = chunk(carry, limits, group.experience)
        group.before = carry, back

    def finish(self, g: int) -> None:
        """Waits for the chunk of a group, and copies what it did to the host, apart from experience."""
        group = self.groups[g]
        carry, counts = group.carry, copies(group.carry.counts)
        reports = unstacked(copies(group.report), self.size)
        if self.size == 1:  # networks and environments stay on the device; everything else is small
            small = copies((carry.episodes._replace(env=None), carry.action, carry.in_a_row))
            episodes = small[0]._replace(env=carry.episodes.env)
            carries = [carry._replace(episodes=episodes, action=small[1], counts=counts, in_a_row=small[2])]
        else:
            views = unstacked(jax.device_get(carry._replace(counts=None)), self.size)
            carries = [one._replace(counts=counts) for one in views]
        for i, (carry, report) in enumerate(zip(carries, reports, strict=True), g * self.size):
            self.carries[i], self.reports[i] = carry, report

    def undo(self) -> None:
        """Puts carries and experience of all runs back before the last chunk, of which nothing was pulled."""
        for group in self.groups:
            if group.before is not None:
                (group.carry, back), group.before = group.before, None
                group.experience = back(group.experience)

    def fault(self, which: int) -> bool:
        """Returns whether the last chunk left something that is not finite in a run."""
        report = self.reports[which]
        stops = report.n_bad > 0 and (not self.program.skips or self.carries[which].in_a_row >= MAX_SKIPPED)
        return bool(report.nonfinite_env or not report.is_finite or stops)

    def pull(self, which: int) -> Progress:
        """Puts what the last chunk did into a run, and returns it; the experience follows when it is read."""
        run, carry, report = self.runs[which], self.carries[which], self.reports[which]
        first_step, run.step = run.step, int(carry.counts.step)
        run.state, run.carry = carry.state, carry.explorer
        put_episodes(run, carry.episodes)
        run.n_updates += int(report.n_updates)
        run.monitor.n_skipped += int(report.n_bad)
        if report.n_updates:
            values = [*report.metrics.values(), report.n_bad]
            run.metrics = Readings(tuple(report.metrics), np.array(values, np.float32))  # type: ignore[arg-type]
        self.program.pull_counts(run, carry)
        run.fetch = partial(self._fetch, which)
        self.groups[which // self.size].before = None
        if run.step >= run.next_look:
            check_bounds(run, run.obs)
        episodes = episodes_in(run, report.log, first_step, run.step)
        return Progress(run.step, episodes, run.metrics, rollout_ended=bool(report.n_updates))

    def _fetch(self, which: int) -> None:
        """Copies the experience of a run to its buffer on the host."""
        group = self.groups[which // self.size]
        experience = group.experience if self.size == 1 else of_run(group.experience, which % self.size)
        self.program.download(self.runs[which], experience, copies(group.carry.counts))

    def raise_fault(self, which: int, limits: Limits) -> NoReturn:
        """Raises the error of a chunk of which nothing was pulled; the run is put before the fault.

        Raises:
            BadEnvironmentError: if a reward or an observation is not finite.
            NonFiniteUpdate: if an update left numbers that are not finite.
        """
        run, before = self.runs[which], self.groups[which // self.size].before
        assert before is not None
        in_a_row = int(np.ravel(before[0].in_a_row)[which % self.size])
        self.undo()
        for one in self.runs:
            one.copy_replay()
        self.runs, self.size, self.mesh = [run], 1, None
        for i in range(int(limits.n_turns)):
            one_turn = limits._replace(n_turns=np.int32(1), progress=np.roll(limits.progress, -i))
            self._repeat(one_turn, in_a_row)
            if self.reports[0].nonfinite_env:
                self._raise_bad_environment(run)
            if self.fault(0):
                self._raise_bad_update(run, one_turn, in_a_row)
            in_a_row = int(self.carries[0].in_a_row)
            self.pull(0)
            run.copy_replay()
        raise AssertionError("the chunk was not finite, and its turns are")

    def _repeat(self, limits: Limits, in_a_row: int) -> None:
        """Takes a chunk from the state of the only run, after so many bad updates in a row."""
        self.push(float(limits.progress[0]), self.runs[0])
        self.groups[0].carry = self.groups[0].carry._replace(in_a_row=jnp.int32(in_a_row))
        self.take(limits, [0])

    def _raise_bad_environment(self, run: Run) -> NoReturn:
        """Raises the error of a reward or an observation of the turn that was taken."""
        result: Any = self.reports[0].result
        run.action = result.action
        check_finite(run, Step(result.obs, result.reward, result.terminated, result.truncated, None), run.step)
        carry = self.carries[0]
        check_obs(run, carry.episodes.obs, int(carry.counts.step), "reset returned")
        raise AssertionError("the environment was not finite, and what it returned is")

    def _raise_bad_update(self, run: Run, limits: Limits, in_a_row: int) -> NoReturn:
        """Raises the error of the first bad update of the next turn, with the state before it and its batch."""
        number = 0
        while True:
            self._repeat(limits._replace(most_updates=np.int32(number + 1)), in_a_row)
            if self.fault(0):
                break
            number += 1
        skipped = int(self.carries[0].in_a_row) if self.program.skips else 0
        self._repeat(limits._replace(most_updates=np.int32(number)), in_a_row)
        carry, group = self.carries[0], self.groups[0]
        clock = Clock(carry.counts.step, carry.episodes.n_finished, limits.progress[1], self.program.n_envs)
        batch = copies(self.compiled(bad_batch)(group.carry, group.experience, clock, np.uint32(number)))
        before = None if self.program.skips else group.carry.state
        raise NonFiniteUpdate(before, batch, clock, skipped, run.n_updates + number)


def with_env(function: Callable[..., Any], program: Any, static: Any, arrays: Any, *arguments: Any) -> Any:
    """Returns the result of ``function(program, env, *arguments)``, given the two parts of the environment."""
    return function(program, joined(static, arrays), *arguments)


def take_chunk(
    mesh: Mesh | None, n: int, program: Program, env: FunctionalEnv, carry: Any, limits: Limits, experience: Any
) -> tuple[Any, Any, ChunkReport]:
    """Returns carry, experience and report of ``n`` runs, which the devices of a mesh share, after a chunk."""
    one = lambda carry, limits, experience: program.chunk(env, carry, experience, limits)  # noqa: E731
    axes = axes_of(carry), None, axes_of(experience)
    return over_runs(one, n, mesh, axes, (axes[0], axes[2], 0))(carry, limits, experience)


def first_action(program: Program, env: FunctionalEnv, carry: Carry, progress: Any) -> jax.Array | None:
    """Returns the first actions of a run."""
    program = program.with_hyperparameters(carry.hyper)
    clock = Clock(carry.counts.step, carry.episodes.n_finished, progress)
    return program.choose(env, carry, program.packing.unpack(carry.state), clock).action  # type: ignore[attr-defined]


def bad_batch(program: Program, env: FunctionalEnv, carry: Carry, experience: Any, clock: Clock, number: Any) -> Any:
    """Returns the batch of a gradient step that was left out in the last turn, the ``number``-th of the turn."""
    return program.batch(env, carry, experience, clock, number)


def next_rows(mesh: Mesh | None, n: int, size: int, program: Any, env: Any, experience: Any) -> Any:
    """Returns what a chunk may change in the replay buffers of ``n`` runs; see :meth:`DeviceReplay.next_rows`."""
    return over_runs(lambda ring: program.replay.next_rows(ring, size), n, mesh, (0,), 0)(experience)


def with_rows(mesh: Mesh | None, n: int, program: Any, env: Any, experience: Any, rows: Any) -> Any:
    """Returns the replay buffers of ``n`` runs before a chunk."""
    return over_runs(program.replay.with_rows, n, mesh, (0, 0), 0)(experience, rows)


def axes_of(tree: Any) -> Any:
    """Returns for each field of a carry or of experience 0, or None if all runs share it."""
    return type(tree)(**{name: None if name in SHARED else 0 for name in tree._fields})


def of_run(tree: Any, which: int) -> Any:
    """Returns the experience of one of several runs."""
    parts = {name: jax.tree.map(lambda leaf: leaf[which], getattr(tree, name)) for name in {*tree._fields} - {*SHARED}}
    return tree._replace(**parts)


def with_shared(tree: Any, make: Callable[[], Any]) -> Any:
    """Returns a carry or experience of several runs, with the fields that all share from the one that ``make`` returns."""
    names = [name for name in tree._fields if name in SHARED]
    of_one = make() if names else None
    return tree._replace(**{name: getattr(of_one, name) for name in names})


def vector_of(run: Run) -> JaxVector:
    """Returns the environments in JAX of a run."""
    vector = functional_vector(run.env)
    assert vector is not None
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


def put_episodes(run: Run, episodes: Any) -> None:
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


def episodes_in(run: Run, log: EpisodeLog, first_step: int, last_step: int) -> list[Episode]:
    """Returns the episodes that ended in a chunk, in the order in which they ended.

    Args:
        run: whose environments and success threshold count.
        log: on the host.
        first_step: total environment steps before the chunk.
        last_step: total environment steps after it.
    """
    threshold = run.env.reward_threshold if run.success_threshold is None else run.success_threshold
    episodes = []
    for turn, env in zip(*(found.tolist() for found in np.nonzero(log.length)), strict=True):
        value = float(log.episode_return[turn, env])
        success = success_by(float(log.success[turn, env]), value, threshold)
        step = min(first_step + (turn + 1) * run.env.n_envs, last_step)
        episodes.append(Episode(step, env, value, int(log.length[turn, env]), success, run.seconds["total"]))
    return episodes


def mesh_of(n_runs: int, devices: Sequence[jax.Device]) -> Mesh | None:
    """Returns the devices that share so many runs; None if one computes all."""
    used = np.array(devices[:n_runs])
    return Mesh(used, (RUNS,)) if len(used) > 1 else None


def filled(runs: Sequence[T], size: int) -> list[T]:
    """Returns the runs, and the first one again until there are ``size``.

    What the additional ones compute is not used. It takes no time, because other devices are busy as long.

    >>> filled("abc", 4)
    ['a', 'b', 'c', 'a']
    """
    return [*runs, *[runs[0]] * (size - len(runs))]


def group_size(n_runs: int, devices: Sequence[jax.Device]) -> int:
    """Returns how many runs are computed at once: a multiple of the number of devices that share them."""
    n_devices = min(max(len(devices), 1), n_runs)
    of_each = -(-n_runs // n_devices)
    is_cpu = not devices or devices[0].platform == "cpu"
    n_groups = -(-of_each // MOST_ON_CPU) if is_cpu else 1
    return n_devices * -(-of_each // n_groups)


def spread(make: Callable[[T], PyTree], runs: Sequence[T], mesh: Mesh | None) -> PyTree:
    """Returns the trees that ``make`` returns for the runs as one, whose leaves have a leading axis of runs.

    The number of runs must be a multiple of the number of devices, each of which gets its share.
    """
    if mesh is None:
        return stacked([make(run) for run in runs])
    size, sharding = len(runs) // mesh.size, NamedSharding(mesh, PartitionSpec(RUNS))
    shares = [
        jax.device_put(stacked([make(run) for run in runs[i * size : (i + 1) * size]]), device)
        for i, device in enumerate(mesh.devices)
    ]

    def joined(*parts: jax.Array) -> jax.Array:
        return jax.make_array_from_single_device_arrays((len(runs), *parts[0].shape[1:]), sharding, parts)

    return jax.tree.map(joined, *shares)


def over_runs(
    function: Callable[..., Any], n: int, mesh: Mesh | None, in_axes: Any, out_axes: Any
) -> Callable[..., Any]:
    """Returns ``function`` of one run for all: ``jax.vmap``, and each device computes its share.

    Args:
        function: of one run.
        n: the number of runs; a single one has no axis.
        mesh: the devices.
        in_axes: 0 for arguments with an axis of runs, None for those without one; trees as for ``jax.vmap``.
        out_axes: likewise of the results.
    """
    if n == 1:
        return function
    mapped = jax.vmap(for_runs(function, n if mesh is None else n // mesh.size), in_axes, out_axes)
    if mesh is None:
        return mapped
    spec = lambda axis: PartitionSpec() if axis is None else PartitionSpec(RUNS)  # noqa: E731
    specs = lambda axes: jax.tree.map(spec, axes, is_leaf=lambda axis: axis is None)  # noqa: E731
    return jax.shard_map(mapped, mesh=mesh, in_specs=specs(in_axes), out_specs=specs(out_axes), check_vma=False)


def stacked(trees: Sequence[PyTree]) -> PyTree:
    """Returns trees of equal structure as one on the device, whose leaves have a leading axis."""

    def joined(*leaves: Any) -> jax.Array:
        on_host = all(isinstance(leaf, np.ndarray) for leaf in leaves)
        return jnp.array(np.stack(leaves)) if on_host else jnp.stack(leaves)

    return jax.tree.map(joined, *trees)


def unstacked(tree: PyTree, n: int) -> list[PyTree]:
    """Returns the ``n`` trees of which :func:`stacked` made one; a single one has no leading axis."""
    return [tree] if n == 1 else [jax.tree.map(lambda leaf, i=i: leaf[i], tree) for i in range(n)]


def copies(tree: PyTree) -> PyTree:
    """Returns copies of arrays on the host."""
    return jax.tree.map(np.array, jax.device_get(tree))
