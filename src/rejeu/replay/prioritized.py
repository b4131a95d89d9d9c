"""Prioritized experience replay: steps are sampled in proportion to their TD errors.

Source: Schaul et al. 2015, "Prioritized Experience Replay" (arXiv 1511.05952), the proportional variant. A step with TD
error ``delta`` has priority ``p = (|delta| + epsilon)^alpha`` and is sampled with probability ``P = p / sum p``. Its
loss is weighted by ``(N P)^-beta``, divided by the largest weight of its batch. ``beta`` increases to 1 over the run.
New steps get the largest priority so far.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rejeu.core import schedules
from rejeu.core.schedules import Schedule
from rejeu.core.types import AnyArray, JsonObject, Settings
from rejeu.core.validation import coerce, number
from rejeu.replay.ring import LAST, Ring, Rows


@dataclass(frozen=True)
class PriorityConfig:
    """Hyperparameters of prioritized replay. The defaults are those of the paper (table 3, proportional)."""

    alpha: float = 0.6
    """Exponent of the priorities: 0 samples uniformly, 1 in proportion to the TD error."""
    beta: float | Schedule = schedules.Linear(0.4, 1.0)
    """Exponent of the importance weights: 0 does not correct the bias, 1 corrects it fully."""
    epsilon: float = 1e-6
    """Added to the absolute TD error, so that every step can be sampled. Positive."""

    def __post_init__(self) -> None:
        coerce(self, "alpha", number, least=0, most=1)
        coerce(self, "beta", schedules.parse)
        coerce(self, "epsilon", number, above=0)


class Draw(NamedTuple):
    """The steps of a batch, which identify them when their priorities are updated."""

    position: np.ndarray
    """Positions in the ring, ``int64 (n,)``."""
    time: np.ndarray
    """Their absolute times, ``int64 (n,)``, which show whether they have been overwritten since."""
    version: int
    """:attr:`Ring.version` at the time of the draw. It differs if the ring has been restored with other steps since."""


class SumTree:
    """A sum tree of ``n`` non-negative values. Updates and sampling take O(log n)."""

    def __init__(self, n: int) -> None:
        self.n_leaves = 1 << max(n - 1, 1).bit_length()
        self.nodes = np.zeros(2 * self.n_leaves, np.float64)
        """Node 1 is the root and contains the sum. The children of node i are 2 i and 2 i + 1."""

    @property
    def total(self) -> float:
        """Sum of all values."""
        return float(self.nodes[1])

    def __getitem__(self, index: AnyArray) -> AnyArray:
        return self.nodes[self.n_leaves + index]

    def set(self, index: np.ndarray, value: ArrayLike) -> None:
        """Sets the values at ``index`` to ``value``, ``(n,)`` or a scalar. Of repeated indices, the last one counts."""
        node = index + self.n_leaves
        self.nodes[node] = value
        for _ in range(self.n_leaves.bit_length() - 1):
            node = node >> 1
            self.nodes[node] = self.nodes[2 * node] + self.nodes[2 * node + 1]

    def fill(self, values: np.ndarray) -> None:
        """Sets the first ``n`` positions to ``values``, ``(n,)``, and all others to 0."""
        self.nodes[:] = 0.0
        self.nodes[self.n_leaves : self.n_leaves + len(values)] = values
        first = self.n_leaves
        while first > 1:
            half = first // 2
            self.nodes[half:first] = self.nodes[first : 2 * first : 2] + self.nodes[first + 1 : 2 * first : 2]
            first = half

    def find(self, mass: np.ndarray) -> np.ndarray:
        """Returns the first positions where the cumulative sum exceeds ``mass``, in [0, total), ``int64 (n,)``."""
        node = np.ones(len(mass), np.int64)
        mass = mass.copy()
        while node[0] < self.n_leaves:
            left_child = 2 * node
            weight = self.nodes[left_child]
            goes_right = (mass >= weight) & (self.nodes[left_child + 1] > 0)
            mass -= np.where(goes_right, weight, 0.0)
            node = left_child + goes_right
        return node - self.n_leaves


class Priorities:
    """The priorities of the steps of a :class:`Ring`. Mutable."""

    def __init__(self, ring: Ring, config: PriorityConfig) -> None:
        self.ring = ring
        self.config = config
        self.tree = SumTree(ring.rows * ring.n_envs)
        self.largest = 1.0
        """Largest priority so far, and the priority of new steps."""

    def add(self, index: np.ndarray, following: np.ndarray) -> None:
        """Adds new steps at ``index``. The rows ``following`` become heads, which cannot be sampled."""
        self.tree.set(following, 0.0)
        self.tree.set(index, self.largest)

    def draw(self, rng: np.random.Generator, n: int, progress: float) -> tuple[Rows, np.ndarray, Draw]:
        """Returns ``n`` steps, their importance weights ``float32 (n,)``, and their :class:`Draw`.

        One step is sampled from each of ``n`` equal segments of the total priority. The object does not store the draw.
        :meth:`update` takes it together with the TD errors of the steps.

        Raises:
            ValueError: if there are no steps.
        """
        tree, ring = self.tree, self.ring
        if not len(ring):
            raise ValueError("the replay buffer is empty: take some environment steps before sampling from it")
        index = tree.find((np.arange(n) + rng.random(n)) * (tree.total / n))
        rng.shuffle(index)
        env = index // ring.rows
        head = ring.head[env]
        time = head - (head - index % ring.rows) % ring.rows
        probability = tree[index] / tree.total
        weight = (len(ring) * probability) ** -float(schedules.at(self.config.beta, progress))
        rows = Rows(env, time, index, ring.kind.take(index))
        return rows, weight.astype(np.float32), Draw(index, time, ring.version)

    def update(self, td_errors: Iterable[tuple[Draw, AnyArray]]) -> None:
        """Updates the priorities of sampled steps from their absolute TD errors, in any shape of size ``n``.

        TD errors of steps that have been overwritten since are ignored. TD errors that are not finite are ignored too,
        because one NaN would make all sums NaN. Such a step keeps its priority.
        """
        for (index, time, version), td_error in td_errors:
            if version != self.ring.version:
                continue
            priority = (np.asarray(td_error, np.float64).ravel() + self.config.epsilon) ** self.config.alpha
            head = self.ring.head[index // self.ring.rows]
            finite = np.isfinite(priority)
            is_updated = (time > head - self.ring.rows) & (self.tree[index] > 0) & finite
            if is_updated.any():
                self.tree.set(index[is_updated], priority[is_updated])
            self.largest = max(self.largest, float(priority.max(where=finite, initial=0.0)))

    def load(self, values: np.ndarray, largest: float) -> None:
        """Replaces all priorities by others, ``(rows * n_envs,)``, such as those that a loop on the device left."""
        self.tree.fill(values)
        self.largest = largest

    def state(self) -> Settings:
        """Returns the state for :meth:`restore`."""
        n = self.ring.rows * self.ring.n_envs
        return {"values": self.tree[np.arange(n)], "largest": self.largest}

    def restore(self, state: JsonObject | None = None) -> None:
        """Restores a state of :meth:`state`. Without a state, all steps of the ring get the largest priority.

        Raises:
            KeyError, ValueError: if the state is corrupted, or belongs to another ring.
        """
        if state is not None:
            values = state["values"]
            steps = self._step_positions()
            if values.shape != (self.ring.rows * self.ring.n_envs,) or values.dtype != np.float64:
                raise ValueError("the priorities are of another replay buffer")
            largest = float(state["largest"])
            largest_leaf = float(np.finfo(np.float64).max) / self.tree.n_leaves  # so that their sum is finite
            if not ((values >= 0) & (values <= largest_leaf)).all() or not 0 < largest <= largest_leaf:
                raise ValueError("the priorities are not finite, or not positive")
            if not np.array_equal(np.flatnonzero(values > 0), np.sort(steps)):
                raise ValueError("the priorities do not belong to the steps of this replay buffer")
            self.tree.fill(values)
            self.largest = largest
            return
        self.tree = SumTree(self.ring.rows * self.ring.n_envs)
        steps = self._step_positions()
        if len(steps):
            self.tree.set(steps, self.largest)

    def draw_of(self, index: np.ndarray, time: np.ndarray) -> Draw:
        """Returns a draw from the current content of this ring, given positions and times from a file.

        Raises:
            ValueError: if they are not positions in this ring.
        """
        good = index.dtype == time.dtype == np.int64 and index.shape == time.shape == (index.size,)
        if not good or not ((index >= 0) & (index < self.ring.rows * self.ring.n_envs)).all():
            raise ValueError("the priorities are of another replay buffer")
        return Draw(index, time, self.ring.version)

    def _step_positions(self) -> np.ndarray:
        """Returns the positions of the ring that contain steps, ordered by environment."""
        ring = self.ring
        positions = []
        for env in range(ring.n_envs):
            times = np.arange(ring.oldest()[env], ring.head[env])
            index = ring.index(np.full(len(times), env), times)
            positions.append(index[ring.kind[index] != LAST])
        return np.concatenate(positions)
