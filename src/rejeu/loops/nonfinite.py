"""Which update was the first to leave numbers that are not finite.

An update says with its metrics whether what it left is finite (:func:`rejeu.loops.finite.all_finite`). The answer is read one
turn later. :class:`NonFiniteMonitor` keeps a copy of the state from some updates ago and the batches since. It repeats these
updates to find the first one to blame, and leaves the agent in the state before it. Large arrays, of weights between wide
layers, are not checked in every update: a number there that is not finite makes the next loss so.

Where such updates are skipped, they undo themselves, check large arrays too, and are counted here.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from jax import Array

from rejeu.core import Clock, Rollout, Transition
from rejeu.loops.finite import MOST_SKIPPED, Broken

if TYPE_CHECKING:
    from rejeu.loops.learner import Learner, PackedState
    from rejeu.loops.packing import Readings
    from rejeu.loops.run import Run

STRETCH = 64
"""Most calls of the update between two copies of the state."""
STRETCH_BYTES = 32 * 2**20
"""Most bytes of batches kept for them."""


class Stretch:
    """A state, and what has been done to it since."""

    def __init__(self, start: PackedState) -> None:
        self.start = start
        """A copy of its own."""
        self.done: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
        """Functions that took the state and these arguments, and returned it, alone or first of a tuple."""
        self.n_updates = 0

        self.previous: Stretch | None = None
        """The one before."""

    def first_to_break(self, learner: Learner, last: int) -> tuple[PackedState, int]:
        """Returns the first thing done, up to number ``last``, that left something not finite, and the state before it."""
        state = learner.copy(self.start)
        for i, (function, arguments) in enumerate(self.done[:last]):
            before = learner.copy(state)
            after = function(state, *arguments)
            state = after[0] if isinstance(after, tuple) else after
            if learner.bad_leaves(state):
                return before, i
        return state, last


class Unread(NamedTuple):
    """An update whose outcome is still on the device."""

    readings: Readings
    batches: Transition | Rollout
    clock: Clock
    stretch: Stretch | None
    """None where updates that break something undo themselves."""
    place: int
    """Which of what was done in that stretch it is."""


class NonFiniteMonitor:
    """Looks after the updates of a run. Mutable."""

    def __init__(self) -> None:
        self.n_skipped = 0
        """Updates that were skipped, in all."""
        self._in_a_row = 0
        self._unread: deque[Unread] = deque()
        self._stretch: Stretch | None = None
        self._most = STRETCH
        self._newest: PackedState | None = None
        """The state that the present stretch has led to."""

    def __len__(self) -> int:
        """Returns the number of updates whose outcome was not looked at."""
        return len(self._unread)

    def update(self, run: Run, learner: Learner, batches: Transition | Rollout, clock: Clock) -> Array | None:
        """Learns from batches as :meth:`Learner.update` does, puts state and metrics into ``run``, returns TD errors."""
        stretch = None if learner.skips else self._on(run, learner, batches)
        place = 0 if stretch is None else len(stretch.done)
        run.state, run.metrics, td_error = learner.update(run.state, batches, clock)
        self._unread.append(Unread(run.metrics, batches, clock, stretch, place))
        if stretch is not None:
            stretch.done.append((learner.update, (batches, clock)))
            stretch.n_updates += 1
        self._newest = run.state
        return td_error

    def observe(self, run: Run, learner: Learner) -> None:
        """Lets the state take in the present observations, if it has a use for them.

        They are copied: the device may read a large array after the environments have written the next step to it.
        """
        if learner.observe is None:
            return
        is_known = run.state is self._newest
        seen = (jax.tree.map(np.copy, run.obs), run.running_return)
        run.state = learner.observe(run.state, *seen)
        if is_known and self._stretch is not None:
            self._stretch.done.append((learner.observe, seen))
            self._newest = run.state

    def _on(self, run: Run, learner: Learner, batches: Transition | Rollout) -> Stretch:
        """Returns the present stretch, or a new one where that is long or something else has changed the state."""
        most = 1 if isinstance(batches, Rollout) else STRETCH
        if self._stretch is not None and self._stretch.n_updates == 1 and most > 1:
            size = sum(leaf.nbytes for leaf in jax.tree.leaves(batches))
            self._most = max(1, min(most, STRETCH_BYTES // max(size, 1)))
        if self._stretch is None or run.state is not self._newest or self._stretch.n_updates >= self._most:
            new = Stretch(learner.copy(run.state))
            if self._stretch is not None and run.state is self._newest:
                new.previous, self._stretch.previous = self._stretch, None
            self._stretch, self._most = new, most
        return self._stretch

    def read(self, run: Run, learner: Learner, n: int | None = None) -> None:
        """Looks at the oldest ``n`` updates (None: all); waits for them.

        Raises:
            Broken: if one of them left numbers that are not finite; ``run.state`` is then what it was before, and the
                running episodes are given up.
        """
        for _ in range(len(self._unread) if n is None else n):
            one = self._unread.popleft()
            n_bad = one.readings.n_bad
            if not n_bad:
                self._in_a_row = 0
                continue
            if one.stretch is not None:
                one = self._culprit(run, learner, one)
            else:
                self.n_skipped += n_bad
                self._in_a_row += n_bad
                if self._in_a_row < MOST_SKIPPED:
                    continue
            in_a_row, self._in_a_row = self._in_a_row, 0
            self._unread.clear()
            self._stretch = self._newest = None
            run.td_errors = []
            run.obs = run.action = None  # what has been chosen since is not to be relied on: new episodes
            raise Broken(one.batches, one.clock, in_a_row)

    @staticmethod
    def _culprit(run: Run, learner: Learner, one: Unread) -> Unread:
        """Returns the first update to blame for what ``one`` found, and puts the state before it into ``run``."""
        stretch, last = one.stretch, one.place
        assert stretch is not None
        if stretch.previous is not None and learner.bad_leaves(stretch.start):
            stretch = stretch.previous
            last = len(stretch.done) - 1
        run.state, place = stretch.first_to_break(learner, last)
        _, arguments = stretch.done[place]
        return one._replace(batches=arguments[0], clock=arguments[1])
