"""The check that updates leave finite numbers, and the search for the update that did not.

Every compiled update reports, with its metrics, whether what it left is finite. :class:`NonFiniteMonitor` reads this one
turn later, when the loop waits for the device anyway. It keeps a copy of a state and the updates since, from which it
recomputes the state before the first bad update. Large arrays are checked only in these copies, on the host, a turn after
a copy was requested: until then NaN in one of them shows in the loss of the next update. With ``nonfinite="skip"`` a bad
update is undone on the device at once (:func:`undo`), and the monitor only counts.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rejeu.core import EXPLAINED_VARIANCE, TD_ERROR, Clock, Metrics, PyTree, Rollout, Transition
from rejeu.io.checkpoint import names
from rejeu.loops.packing import PackedState, Readings

MAX_CALLS = 64
"""Largest number of calls after which the state is copied again."""
MAX_BYTES = 32 * 2**20
"""Number of bytes of batches after which the state is copied again."""
MAX_SKIPPED = 100
"""Number of successive skipped updates after which training stops, because nothing is learned."""
FINITE = "finite"
"""Name among the metrics for whether a gradient step was kept, where bad ones are undone."""
WIDTH, FEW = 16, 256


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
    found = []
    for name, leaf in zip(names(tree), jax.tree.leaves(tree), strict=True):
        array = np.asarray(leaf)
        if array.dtype.kind == "f" and not (ok := np.isfinite(array)).all():
            found.append(f"{name} ({array[~ok].ravel()[0]})")
    return found


class NonFiniteUpdate(Exception):
    """An update left NaN or infinity; :func:`rejeu.loops.finite.reported` explains it."""

    def __init__(
        self, state: PackedState | None, batches: Transition | Rollout, clock: Clock, in_a_row: int, n_updates: int
    ) -> None:
        super().__init__("an update left numbers that are not finite")
        self.state = state
        """The state before it; None if the update was undone."""
        self.n_updates = n_updates
        """Total number of gradient steps before it."""
        self.batches, self.clock, self.in_a_row = batches, clock, in_a_row
        self.which = 0
        """Its run, where several are trained together."""


def gradient_steps(reward: Array | np.ndarray) -> int:
    """Returns the number of gradient steps on samples, by their rewards: 1 on a batch, or one on each of several."""
    return 1 if reward.ndim == 1 else len(reward)


class Call(NamedTuple):
    """A function that changed the state."""

    function: Callable[..., Any]
    """Takes the state and the arguments; returns the new state, alone or first in a tuple."""
    arguments: tuple[Any, ...]
    """Of an update, the batches and the clock."""
    readings: Readings | None
    """What an update reported; None for other functions."""
    n_updates: int
    """Total number of gradient steps before it."""


class NonFiniteMonitor:
    """Observes the updates of a run. Mutable."""

    def __init__(
        self, copy: Callable[[PackedState], PackedState], is_finite: Callable[[PackedState], bool], skips: bool
    ) -> None:
        """Takes functions that copy and check a state, and whether bad updates undo themselves, so that neither is needed."""
        self.n_skipped = 0
        """Total number of skipped updates."""
        self._copy, self._is_finite, self._skips = copy, is_finite, skips
        self._in_a_row = 0
        self._copied: PackedState | None = None
        """A copy of a state whose updates were all checked."""
        self._calls: list[Call] = []
        """What has changed the state since the copy."""
        self._newest: PackedState | None = None
        """The state after these calls."""
        self._next: tuple[int, PackedState | None] | None = None
        """The number of calls before a newer copy, and that copy, until all of these calls were checked."""
        self._most: int | None = None
        """Number of calls after which the state is copied again; None until a batch is known."""
        self._unread: deque[int] = deque()
        """Indices of the calls whose readings have not been checked."""

    def __len__(self) -> int:
        """Returns the number of updates whose readings have not been checked."""
        return len(self._unread)

    def follow(self, state: PackedState) -> None:
        """Copies the state unless it is the one that the recorded calls led to; to be called before an update.

        Raises:
            NonFiniteUpdate: as :meth:`read`, if the state was replaced while updates were still to be looked at.
        """
        if state is not self._newest and not self._skips:
            self.read()
            self._begin(state)

    def record(
        self,
        state: PackedState,
        function: Callable[..., Any],
        *arguments: Any,
        readings: Any = None,
        n_updates: int = 0,
    ) -> None:
        """Records a call of ``function`` that returned ``state``.

        An update also has ``readings``, and ``n_updates``, the total number of gradient steps before it.
        """
        if readings is not None:
            if self._most is None:
                n_bytes = sum(leaf.nbytes for leaf in jax.tree.leaves(arguments[0]))
                self._most = min(max(MAX_BYTES // max(n_bytes, 1), 1), MAX_CALLS)
            self._unread.append(len(self._calls))
        self._calls.append(Call(function, arguments, readings, n_updates))
        self._newest = state

    def read(self, n: int | None = None) -> None:
        """Checks the oldest ``n`` updates (None: all); waits for them.

        Raises:
            NonFiniteUpdate: if one of them left NaN or infinity, or if too many in a row were skipped.
        """
        for _ in range(len(self._unread) if n is None else n):
            place = self._unread.popleft()
            readings = self._calls[place].readings
            assert readings is not None
            n_bad = readings.n_bad
            self._in_a_row = self._in_a_row + n_bad if n_bad else 0
            self.n_skipped += n_bad if self._skips else 0
            if n_bad and (not self._skips or self._in_a_row >= MAX_SKIPPED):
                raise self._error(place)
        if n is not None:
            self._renew()
        elif self._calls:
            self._check(len(self._calls), self._newest)
            if len(self._calls) >= (self._most or 1) or isinstance(self._calls[-1].arguments[0], Rollout):
                self._begin(self._newest)  # a rollout is a view of a buffer that is soon overwritten

    def _renew(self) -> None:
        """Copies the state after many calls, and forgets these calls in a later turn, when they and the copy are checked."""
        if self._next is None:
            if self._most is not None and len(self._calls) >= self._most:
                assert self._newest is not None
                self._next = len(self._calls), None if self._skips else self._copy(self._newest)
        elif not self._unread or self._unread[0] >= self._next[0]:
            n, copied = self._next
            self._check(n, copied)
            self._copied, self._calls, self._next, self._most = copied, self._calls[n:], None, None
            self._unread = deque(place - n for place in self._unread)

    def _check(self, n: int, state: PackedState | None) -> None:
        """Raises the error of the first bad update unless the state after the first ``n`` calls is finite."""
        updates = [i for i, call in enumerate(self._calls[:n]) if call.readings is not None]
        if updates and state is not None and not self._skips and not self._is_finite(state):
            raise self._error(updates[-1])

    def _begin(self, state: PackedState | None) -> None:
        """Forgets all calls and copies the state that they led to."""
        self._calls, self._newest, self._next, self._most = [], state, None, None
        self._unread.clear()
        self._copied = None if state is None or self._skips else self._copy(state)

    def _error(self, place: int) -> NonFiniteUpdate:
        """Returns the error of the first bad update, which is the one at ``place`` or before; forgets all calls."""
        state = self._copied
        for i, call in enumerate(self._calls[:place]):
            if state is None:
                break
            before = self._copy(state)
            after = call.function(state, *call.arguments)
            state = after[0] if isinstance(after, tuple) else after
            if call.readings is not None and not self._is_finite(state):
                state, place = before, i
                break
        (batches, clock), n_updates = self._calls[place].arguments, self._calls[place].n_updates
        in_a_row, self._in_a_row = self._in_a_row, 0
        self._begin(None)
        return NonFiniteUpdate(state, batches, clock, in_a_row, n_updates)
