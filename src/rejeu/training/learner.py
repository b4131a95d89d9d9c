"""The compiled functions of an algorithm that loops and agents call, such as ``act`` and ``update``.

Each array that enters or leaves a compiled function costs about a microsecond. The state of SAC has some fifty, and as a
tree of modules Python must flatten it as well. Packed by dtype into three vectors it makes a whole step 6 to 12 % faster;
see ``docs/performance.md``. Inside compiled code the arrays are slices of the vectors. Metrics are one vector, whose last
number says whether what an update left is finite.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rejeu.algorithms.contract import check_state
from rejeu.core import xla
from rejeu.core.algorithm import (
    EXPLAINED_VARIANCE,
    TD_ERROR,
    Algorithm,
    AnyArray,
    Clock,
    Explorer,
    Metrics,
    PyTree,
    Rollout,
    Transition,
    copy,
    names,
)
from rejeu.core.prng import nth
from rejeu.exploration import explorer as exploration
from rejeu.exploration.noise import Noise

NO_TD_ERROR = (
    "prioritized replay needs the absolute TD error of each transition: return it from update among the metrics, as TD_ERROR "
    "of shape (batch,); it returned {}"
)
LARGE = 2**13
"""Number of elements above which an array is not packed, because copying it costs more than it saves."""
PackedState = list[Array]
"""The vectors of a :class:`Packing`."""
FINITE = "finite"
"""Name among the metrics for whether a gradient step was kept, where bad ones are undone."""
WIDTH, FEW = 16, 256
"""Parts of a vector that are added up, and the size up to which a vector is left as it is; see :func:`check`."""


class Packing:
    """How trees of one structure are packed: arrays of equal dtype into one vector, large ones as they are. Immutable."""

    def __init__(self, tree: PyTree) -> None:
        """Plans for trees of the structure, shapes and dtypes of ``tree``, whose leaves have ``shape`` and ``dtype``."""
        leaves, self.structure = jax.tree.flatten(tree)
        self.shapes: list[tuple[int, ...]] = [tuple(leaf.shape) for leaf in leaves]
        self.sizes = [math.prod(shape) for shape in self.shapes]
        small: dict[Any, list[int]] = {}
        for i, leaf in enumerate(leaves):
            if self.sizes[i] <= LARGE:
                small.setdefault(np.dtype(leaf.dtype), []).append(i)
        self.groups = list(small.values())
        """Indices of the leaves that share a vector, by vector."""
        self.large = [i for i, size in enumerate(self.sizes) if size > LARGE]
        self.longest = max((sum(self.sizes[i] for i in group) for group in self.groups), default=0)
        """Number of elements of the longest vector."""

    def pack(self, tree: PyTree, concatenate: Callable[..., Any] = jnp.concatenate) -> list[AnyArray]:
        """Returns the vectors of ``tree`` and then its large leaves; with ``np.concatenate`` of NumPy arrays."""
        leaves = jax.tree.leaves(tree)
        vectors = [concatenate([leaves[i].reshape(-1) for i in group]) for group in self.groups]
        return vectors + [leaves[i] for i in self.large]

    def unpack(self, arrays: list[AnyArray]) -> PyTree:
        """Returns the tree that was packed: the inverse of :meth:`pack`."""
        leaves: list[AnyArray] = [None] * len(self.shapes)
        for vector, group in zip(arrays, self.groups, strict=False):
            end = 0
            for i in group:
                begin, end = end, end + self.sizes[i]
                leaves[i] = vector[begin:end].reshape(self.shapes[i])
        for i, array in zip(self.large, arrays[len(self.groups) :], strict=True):
            leaves[i] = array
        return jax.tree.unflatten(self.structure, leaves)


@partial(jax.tree_util.register_dataclass, data_fields=("vector",), meta_fields=("names",))
@dataclass(frozen=True, eq=False)
class Readings(Mapping[str, Array]):
    """The metrics of an update: named scalars in one vector on the device. Reading one waits for it."""

    names: tuple[str, ...]
    vector: Array
    """Its last element has no name: the number of gradient steps that left NaN or infinity."""

    @classmethod
    def of(cls, scalars: Mapping[str, Array], n_bad: Array | int = 0) -> Readings:
        """Packs scalars and the number of bad gradient steps, inside compiled code."""
        return cls(tuple(scalars), jnp.stack([*scalars.values(), jnp.asarray(n_bad, jnp.float32)]))

    @property
    def n_bad(self) -> int:
        """The number of gradient steps that left NaN or infinity; waits for the device."""
        return int(np.asarray(self.vector)[-1])

    def __getitem__(self, name: str) -> Array:
        if name not in self.names:
            raise KeyError(name)
        return self.vector[self.names.index(name)]

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)


class Learner:
    """The pure functions of an algorithm, compiled. Holds no state: every function takes it, packed into a few vectors.

    ``act`` is ``_act`` compiled by ``jax.jit``, and so on.
    """

    def __init__(self, algorithm: Algorithm, noise: Noise | None, skips: bool = False) -> None:
        """Takes an algorithm and the action noise of training; ``skips`` undoes updates that leave NaN or infinity."""
        self.algorithm, self.skips = algorithm, skips
        self.explorer = exploration.make(algorithm, noise)
        self.shapes = jax.eval_shape(algorithm.init, jax.ShapeDtypeStruct((2,), jnp.uint32))
        """The unpacked state, with shapes in place of arrays."""
        self.packing = Packing(self.shapes)
        self.init = xla.run_once(self._init)
        self.act = self.sample = jax.jit(partial(self._act, self.explorer))
        if noise is not None or (algorithm.recall is None and algorithm.explorer is not None):
            self.sample = jax.jit(partial(self._act, exploration.plain(algorithm)))
        self.update = jax.jit(self._update, donate_argnums=0)
        self.observe = None if algorithm.observe is None else jax.jit(self._observe, donate_argnums=0)
        self.exploit, self.recall = jax.jit(self._exploit), jax.jit(self._recall)
        self.action_values, self.state_value = jax.jit(self._action_values), jax.jit(self._state_value)
        self.copy = jax.jit(copy)
        self.programs: dict[Any, Any] = {}
        """Compiled programs of training on the device, by what they are compiled for."""

    def _act(
        self, explorer: Explorer, state: PackedState, carry: PyTree, obs: PyTree, ended: Array, key: Array, clock: Clock
    ) -> tuple[Array, PyTree]:
        """Returns actions drawn for ``obs`` ``(n_envs, ...)``, and the carry of exploration after them.

        ``ended``, ``bool (n_envs,)``, is where an episode has just begun. ``act`` draws with the noise of training, and
        ``sample`` without it.
        """
        actor = self.algorithm.actor(self.packing.unpack(state))
        return explorer.act(carry, actor, obs, ended, nth(key, clock.step), clock)

    def _update(
        self, state: PackedState, batches: Transition | Rollout, clock: Clock
    ) -> tuple[PackedState, Readings, Array | None]:
        """Takes a gradient step on a batch, or one on each of several in a scan, or learns from a rollout.

        Args:
            state: donated.
            batches: leaves ``(batch, ...)`` or ``(steps, batch, ...)``.
            clock: where the run is; leaves ``()``, or ``(steps,)`` where every step has its own.

        Returns:
            The new state, the metrics (means over the steps), and the absolute TD errors, shaped like the rewards, if the
            batches have importance weights.
        """

        def step(before: PyTree, drawn: tuple[PyTree, Clock]) -> tuple[PyTree, Metrics]:
            after, metrics = self.algorithm.update(before, *drawn)
            metrics = {name: jnp.asarray(value) for name, value in metrics.items()}
            return undo(before, after, metrics) if self.skips else (after, metrics)

        before = xla.one_kernel(self.packing.unpack)(state)
        is_one = isinstance(batches, Rollout) or batches.reward.ndim == 1
        clocks = clock if is_one else jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, len(batches.reward)), clock)
        after, metrics = step(before, (batches, clocks)) if is_one else jax.lax.scan(step, before, (batches, clocks))
        # Without the barrier XLA would compute the optimizer's step once more for the check.
        state = jax.lax.optimization_barrier(xla.one_kernel(self.packing.pack, self.packing.longest)(after))
        td_error = td_error_of(metrics, batches)
        metrics.pop(TD_ERROR, None)
        return state, readings(state[: len(self.packing.groups)], metrics), td_error  # the monitor checks large arrays

    def _init(self, key: Array) -> PackedState:
        """Returns the state before learning."""
        state = self.algorithm.init(key)
        check_state(state, self.shapes, "init")
        return self.packing.pack(state)

    def _observe(self, state: PackedState, obs: PyTree, running_return: Array) -> PackedState:
        """Returns the state, which is donated, with observations added to its statistics (see ``Algorithm.observe``)."""
        assert self.algorithm.observe is not None
        return self.packing.pack(self.algorithm.observe(self.packing.unpack(state), obs, running_return))

    def _exploit(self, state: PackedState, obs: PyTree) -> Array:
        """Returns the deterministic actions for ``obs`` ``(batch, ...)``."""
        return self.algorithm.exploit(self.algorithm.actor(self.packing.unpack(state)), obs)

    def _recall(self, state: PackedState, carry: PyTree, obs: PyTree, ended: Array) -> tuple[Array, PyTree]:
        """Returns the deterministic actions of a recurrent policy and its memory after ``obs`` ``(batch, ...)``."""
        assert self.algorithm.recall is not None
        return self.algorithm.recall(carry, self.algorithm.actor(self.packing.unpack(state)), obs, ended)

    def _action_values(self, state: PackedState, obs: PyTree, action: Array | None) -> Array:
        """Returns the critics' values; see ``Algorithm.action_values``."""
        assert self.algorithm.action_values is not None
        return self.algorithm.action_values(self.packing.unpack(state), obs, action)

    def _state_value(self, state: PackedState, carry: PyTree, obs: PyTree, ended: Array) -> Array:
        """Returns the critic's values of states; see ``Algorithm.state_value``."""
        assert self.algorithm.state_value is not None
        return self.algorithm.state_value(carry, self.algorithm.actor(self.packing.unpack(state)), obs, ended)

    def state(self, packed: PackedState) -> PyTree:
        """Returns a packed state as the algorithm's own class, in buffers of its own; waits for the device."""
        return jax.device_put(self.packing.unpack([np.array(array) for array in packed]))  # quicker than to compile it

    def pack(self, state: PyTree) -> PackedState:
        """Returns a state packed, in buffers of its own: the inverse of :meth:`state`."""
        return jax.device_put(self.packing.pack(jax.tree.map(np.array, state), np.concatenate))

    def bad_leaves(self, state: PackedState) -> list[str]:
        """Returns the names of the leaves of a packed state that are not finite; waits for the device."""
        return [] if is_finite(state) else bad_leaves(self.packing.unpack([np.asarray(a) for a in state]))

    def initial_memory(self, n: int) -> PyTree:
        """Returns the memory of the policy at the start of ``n`` episodes; ``()`` if it has none."""
        return exploration.plain(self.algorithm).init(self.algorithm.actor(self.shapes), n)

    @cached_property
    def memory_shapes(self) -> PyTree:
        """The shapes of the memory of one episode. Computed once: it takes longer than a prediction."""
        return jax.eval_shape(lambda: self.initial_memory(1))

    def initial_carry(self, n_envs: int) -> PyTree:
        """Returns the carry of the exploration of ``n_envs`` environments before their first episodes."""
        return self.explorer.init(self.algorithm.actor(self.shapes), n_envs)


def td_error_of(metrics: Metrics, batches: Transition | Rollout) -> Array | None:
    """Returns the absolute TD errors of weighted batches, or raises ``ValueError`` if there are none; None for others."""
    if not isinstance(batches, Transition) or batches.weight is None:
        return None
    td_error = metrics.get(TD_ERROR)
    if td_error is None or td_error.shape != batches.reward.shape:
        raise ValueError(NO_TD_ERROR.format("none" if td_error is None else td_error.shape))
    return td_error


def is_finite(state: PackedState) -> bool:
    """Returns whether all numbers of a packed state are finite; waits for the device."""
    return all(np.isfinite(array).all() for array in map(np.asarray, state) if array.dtype.kind == "f")


def check(arrays: Iterable[Array], metrics: Metrics) -> Array:
    """Returns whether all numbers of a state and its metrics are finite, ``bool[]``; used inside compiled code."""
    vectors = [array.reshape(-1) for array in (*arrays, *checked(metrics).values())]
    floats = [_folded(vector).astype(jnp.float32) for vector in vectors if jnp.issubdtype(vector.dtype, jnp.floating)]
    if not floats:
        return jnp.bool(True)
    return jnp.isfinite(jnp.sum(_folded(jnp.concatenate(floats)) * jnp.float32(0)))  # 0 * x is NaN unless x is finite


def checked(metrics: Metrics) -> Metrics:
    """Returns the metrics that must be finite.

    TD errors are left out, which priorities ignore if they are NaN, and so is the explained variance, which is undefined
    if all returns are equal.
    """
    return {name: value for name, value in metrics.items() if name not in (TD_ERROR, EXPLAINED_VARIANCE)}


def _folded(x: Array) -> Array:
    """Returns a sixteenth as many numbers, one of which is NaN unless all of ``x`` are finite; short vectors unchanged.

    XLA on a CPU sums a single vector number by number. Adding up sixteen parts of it is several times faster.
    """
    if x.size <= FEW:
        return x
    n, zero = -(-x.size // WIDTH), jnp.zeros((), x.dtype)
    begins = [min(i * n, x.size - n) for i in range(WIDTH)]  # the last parts overlap
    return sum((x[begin : begin + n] * zero for begin in begins), jnp.zeros(n, x.dtype))


def undo(before: PyTree, after: PyTree, metrics: Metrics) -> tuple[PyTree, Metrics]:
    """Returns the state ``after`` an update, or the one ``before`` it unless the update left finite numbers.

    The metrics then say so, and TD errors are NaN, which leaves priorities unchanged. Used inside compiled code.
    """
    finite = check(jax.tree.leaves(after), metrics)
    if TD_ERROR in metrics:
        metrics = metrics | {TD_ERROR: jnp.where(finite, metrics[TD_ERROR], jnp.nan)}
    return jax.tree.map(lambda new, old: jnp.where(finite, new, old), after, before), metrics | {FINITE: finite}


def readings(state: Iterable[Array], metrics: Metrics) -> Readings:
    """Returns the means of metrics over gradient steps, and how many of these were bad; used inside compiled code.

    ``state`` are the arrays to be checked.
    """
    if FINITE not in metrics:  # one bad step spoils all that follow
        return Readings.of({name: jnp.mean(value) for name, value in metrics.items()}, ~check(state, metrics))
    finite = metrics.pop(FINITE)
    means = {name: jnp.mean(value, where=finite) for name, value in metrics.items()}
    return Readings.of(means, jnp.sum(~finite))


def bad_leaves(tree: PyTree) -> list[str]:
    """Returns the dotted names of the leaves that hold NaN or infinity, each with the first such number."""
    bad = []
    for name, leaf in zip(names(tree), jax.tree.leaves(tree), strict=True):
        array = np.asarray(leaf)
        if array.dtype.kind == "f" and not (ok := np.isfinite(array)).all():
            bad.append(f"{name} ({array[~ok].ravel()[0]})")
    return bad
