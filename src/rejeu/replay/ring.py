"""A ring of steps per environment, addressed by absolute time.

Each environment writes one endless row of time steps 0, 1, 2, ...; the ring keeps the newest ``rows`` of them. The row at
time t holds the observation at t and, once the step was taken, its action and reward. The successor of t is the
observation at t + 1, so every observation is stored once. Where an episode ends, one further row holds the final
observation, marked ``LAST``; the next episode begins in the row after it. No row is ever moved.

Of stacked frames (``frame_stack``) a row holds the newest only, and the others are found in the rows before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import DTypeLike

from rejeu.core.algorithm import PyTree
from rejeu.core.hardware import free_memory
from rejeu.core.spaces import Leaf, flat_keys
from rejeu.core.types import Observation

STEP, TERMINATED, LAST = 0, 1, 2
"""Kinds of row: an ordinary step, a step into a terminal state of the MDP, a final observation without a step."""
COUNTERS = ("since_start", "until_end")
"""Counters that a ring can keep for every row beside what the environment said: see :func:`episode_counters`."""


class Rows(NamedTuple):
    """Rows that were chosen, ``(n,)`` each."""

    env: np.ndarray
    """Of which environments, ``int64``."""
    time: np.ndarray
    """At which absolute times, ``int64``."""
    position: np.ndarray
    """Where in the ring they stand, ``int64``."""
    kind: np.ndarray
    """Of which kind they are, ``uint8``."""


class Ring:
    """The storage beneath every replay buffer. Mutable; ``add`` and ``begin`` write in place."""

    def __init__(
        self,
        capacity: int,
        n_envs: int,
        obs_leaves: tuple[Leaf, ...],
        obs_structure: PyTree,
        action_shape: tuple[int, ...],
        action_dtype: DTypeLike,
        frame_stack: int | None = None,
        counters: Sequence[str] = (),
        memory_size: int = 0,
    ) -> None:
        """Reserves ``capacity // n_envs`` rows for each environment (at least 2, and more than ``frame_stack``).

        Images whose first axis has length ``frame_stack`` are stored as single frames, oldest first. Each of ``counters``
        (names in ``COUNTERS``) takes 4 bytes a row; ``frame_stack`` adds ``since_start``. ``memory_size`` is how many numbers
        a policy with memory remembers, of which each takes 4 bytes a row too.

        Raises:
            MemoryError: if the machine cannot hold the rows, with the numbers.
            ValueError: if ``frame_stack`` is given and no observation leaf is such a stack.
        """
        self.n_envs, self.frame_stack = n_envs, frame_stack
        self.obs_leaves, self.obs_structure = obs_leaves, obs_structure
        self.rows = max(capacity // n_envs, 2, 0 if frame_stack is None else frame_stack + 1)
        self.stacked = stacked_leaves(obs_leaves, frame_stack)
        self._names = [f"obs.{i}" for i in range(len(obs_leaves))]
        counter_names = {*counters, *(() if frame_stack is None else ("since_start",))}
        self.counters = tuple(name for name in COUNTERS if name in counter_names)
        """Which of ``COUNTERS`` are kept."""
        record = record_dtype(obs_leaves, self.stacked, action_shape, action_dtype, self.counters)
        frames = [leaf.nbytes // leaf.shape[0] for leaf, is_ in zip(obs_leaves, self.stacked, strict=True) if is_]
        n = self.rows * n_envs
        check_memory((record.itemsize + 1 + sum(frames) + 4 * memory_size) * n, capacity)
        self.records = np.zeros(n, record)
        """The rows except for kinds and frames. ``obs``, ``action``, ``reward`` and the counters are views of it."""
        self.obs = [
            np.zeros((n, *leaf.shape[1:]), leaf.dtype) if self.stacked[i] else self.records[f"obs.{i}"]
            for i, leaf in enumerate(obs_leaves)
        ]
        self.action, self.reward = self.records["action"], self.records["reward"]
        self.since_start = self.records["since_start"] if "since_start" in counter_names else None
        """Steps since the row's episode began, or since its oldest row in a file; None if not kept."""
        self.until_end = self.records["until_end"] if "until_end" in counter_names else None
        """Steps to the ``LAST`` row of the episode; 0 while it runs, and in that row itself; None if not kept."""
        self.memory = np.zeros((n, memory_size), np.float32)
        """The memory of networks before each row's observation, ``(n, memory_size)``."""
        self.kind = np.zeros(n, np.uint8)
        """Separate from the records, where it would take 4 bytes, because sampling reads nothing else."""
        self.head = np.full(n_envs, -1, np.int64)
        """Absolute time of each environment's newest row; -1 before the first."""
        self.n_steps = np.zeros(n_envs, np.int64)
        """Steps kept, by environment: the rows that are not ``LAST`` and not the newest."""
        self.start = np.zeros(n_envs, np.int64)
        """Absolute time at which the episode of each environment's newest row began."""
        self.all_envs = np.arange(n_envs)
        self._all: slice | int = 0 if n_envs == 1 and frame_stack is None else slice(None)
        """Selects all environments. A single one is selected by a number, with which NumPy is several times faster."""
        self.base = self.all_envs * self.rows
        """Positions of each environment's first row."""
        self.version = 0
        """Increases when rows are replaced by those of a file."""
        self._keys = flat_keys(obs_structure)

    def __len__(self) -> int:
        """Number of steps that can be sampled."""
        return int(self.n_steps.sum())

    @property
    def nbytes(self) -> int:
        """Bytes reserved."""
        stacks = [array for array, stacked in zip(self.obs, self.stacked, strict=True) if stacked]
        return self.records.nbytes + self.memory.nbytes + self.kind.nbytes + sum(array.nbytes for array in stacks)

    def begin(self, obs: Observation, envs: np.ndarray | None = None) -> None:
        """Starts an episode with ``obs`` ``(n_envs, ...)`` in the environments ``envs`` (indices; None: all).

        An episode that still runs there ends with its newest row, without a terminal state.
        """
        envs = self.all_envs if envs is None else envs
        for env in envs[self.head[envs] >= 0]:
            self._close(env)
        index = self._advance(envs)
        self.start[envs] = self.head[envs]
        if self.since_start is not None:
            self.since_start[index] = 0
        self._write_obs(index, obs, envs)

    def add(
        self, action: np.ndarray, reward: np.ndarray, terminated: np.ndarray, next_obs: Observation
    ) -> tuple[np.ndarray, np.ndarray]:
        """Records one step of each environment, ``(n_envs, ...)``.

        Returns the positions of the steps and of the rows after them.
        """
        envs = self._all
        index = self.base[envs] + self.head[envs] % self.rows
        self.action[index] = action[envs]
        self.reward[index] = reward[envs]
        self.kind[index] = terminated[envs]
        following = self._advance(envs)
        self.n_steps[envs] += 1
        if self.since_start is not None:
            self.since_start[following] = self.head[envs] - self.start[envs]
        self._write_obs(following, next_obs, envs)
        return index, following

    def remember(self, memory: np.ndarray, ended: np.ndarray) -> None:
        """Writes what is remembered before the newest observations, ``(n_envs, memory_size)``; nothing where ``ended``."""
        self.memory[self.index(self.all_envs, self.head)] = np.where(ended[:, None], np.float32(0), memory)

    def index(self, env: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Returns the positions of rows given by environment and absolute time."""
        return time % self.rows if self.n_envs == 1 else self.base[env] + time % self.rows

    def at(self, env: np.ndarray, time: np.ndarray) -> Rows:
        """Returns the rows of these environments at these absolute times, all ``(n,)``."""
        index = self.index(env, time)
        return Rows(env, time, index, self.kind.take(index))

    def oldest(self) -> np.ndarray:
        """Returns the absolute time of the oldest row that is kept, by environment, ``(n_envs,)``."""
        return np.maximum(self.head - self.rows + 1, 0)

    def draw(self, rng: np.random.Generator, n: int) -> Rows:
        """Returns ``n`` steps drawn uniformly, with replacement.

        Rows that turn out to be ``LAST`` are drawn again.

        Raises:
            ValueError: if the ring is empty.
        """
        if not np.count_nonzero(self.n_steps):
            raise ValueError("the replay buffer is empty: take some environment steps before sampling from it")
        rows = self._draw_rows(rng, n)
        while LAST in rows.kind.tobytes():  # for few rows much faster than comparing
            again = np.flatnonzero(rows.kind == LAST)
            for column, redrawn in zip(rows, self._draw_rows(rng, len(again)), strict=True):
                column[again] = redrawn
        return rows

    def _draw_rows(self, rng: np.random.Generator, n: int) -> Rows:
        """Returns ``n`` rows of any kind except the newest ones, drawn uniformly."""
        if self.n_envs == 1:
            head = int(self.head[0])
            oldest = max(head - self.rows + 1, 0)
            return self.at(np.zeros(n, np.int64), oldest + (rng.random(n) * (head - oldest)).astype(np.int64))
        ends = np.cumsum(np.maximum(self.head - self.oldest(), 0))
        ticket = (rng.random(n) * ends[-1]).astype(np.int64)
        env = np.searchsorted(ends, ticket, side="right")
        return self.at(env, self.head[env] - (ends[env] - ticket))

    def read(self, index: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        """Returns copies of the rows at positions ``index`` as records, and their observation leaves, stacks rebuilt.

        Both have the shape of ``index``. Before an episode's first frame a stack repeats it, like
        ``FrameStackObservation(padding_type="reset")``. If the episode began before the oldest row, that row's frame is
        repeated.
        """
        records = self.records.take(index)
        frames: Any = None if self.frame_stack is None else self._frames(index, records["since_start"])
        stores = zip(self.obs, self.stacked, self._names, strict=True)
        return records, [leaf.take(frames, axis=0) if stacked else records[name] for leaf, stacked, name in stores]

    def read_leaf(self, leaf: int, index: np.ndarray) -> np.ndarray:
        """Returns one observation leaf, which is no stack, of the rows at positions ``index``; see :meth:`read`."""
        return self.records.take(index)[f"obs.{leaf}"]

    def _frames(self, index: np.ndarray, since_start: np.ndarray) -> np.ndarray:
        """Returns the positions of the frames of the stacks at ``index``, oldest first, ``(*index.shape, frame_stack)``."""
        assert self.frame_stack is not None
        env, slot = np.divmod(index, self.rows)
        head = self.head[env]
        since_oldest = np.minimum(head, self.rows - 1) - (head - slot) % self.rows
        available = np.minimum(since_oldest, since_start)
        back = np.minimum(np.arange(self.frame_stack)[::-1], available[..., None])
        return self.base[env][..., None] + (slot[..., None] - back) % self.rows

    def tree(self, obs_leaves: Sequence[object]) -> PyTree:
        """Returns observation leaves in the structure of the environment's space."""
        return jax.tree.unflatten(self.obs_structure, obs_leaves)

    def _advance(self, envs: np.ndarray | slice | int) -> np.ndarray:
        """Makes room for the next row of each environment, in place of its oldest, and returns the positions."""
        self.head[envs] += 1
        head = self.head[envs]
        index = self.base[envs] + head % self.rows
        if np.count_nonzero(head >= self.rows):
            self.n_steps[envs] -= (head >= self.rows) & (self.kind[index] != LAST)
        self.kind[index] = STEP
        if self.until_end is not None:
            self.until_end[index] = 0
        return index

    def _close(self, env: int) -> None:
        """Marks the newest row of ``env`` as the final observation of its episode."""
        head = int(self.head[env])
        self.kind[int(self.base[env]) + head % self.rows] = LAST
        if self.until_end is not None:
            times = np.arange(max(int(self.start[env]), head - self.rows + 1), head + 1)
            self.until_end[self.base[env] + times % self.rows] = head - times

    def _write_obs(self, index: np.ndarray, obs: Observation, envs: np.ndarray | slice | int) -> None:
        """Writes observations ``(n_envs, ...)`` at ``index``, and of stacks the newest frame."""
        leaves = jax.tree.leaves(obs) if self._keys is None else [obs[key] for key in self._keys]
        for store, leaf, stacked in zip(self.obs, leaves, self.stacked, strict=True):
            store[index] = leaf[envs, -1] if stacked else leaf[envs]
        if self.frame_stack is not None:
            self._check_stacks(index, leaves, envs)

    def _check_stacks(self, index: np.ndarray, leaves: list[np.ndarray], envs: np.ndarray | slice | int) -> None:
        """Raises ``ValueError`` if the older frames of a stack are not those of the rows before."""
        # A run may begin an episode in the ring midway, whose older frames are then padded like those of any other; the
        # first that an environment ever begins does follow a reset, and shows how its stacks are padded.
        assert self.frame_stack is not None
        length = np.where(self.head[envs] == 0, self.frame_stack, self.head[envs] - self.start[envs] + 1)
        for rebuilt, leaf, stacked in zip(self.read(index)[1], leaves, self.stacked, strict=True):
            if stacked:
                differs = (rebuilt != leaf[envs]).any(axis=tuple(range(2, leaf.ndim)))
                if (differs[:, ::-1] & (np.arange(leaf.shape[1]) < length[:, None])).any():
                    raise ValueError(
                        f"frame_stack={self.frame_stack}: an observation does not consist of the frames of the steps "
                        "before it, oldest first, the episode's first one repeated (gymnasium.wrappers."
                        "FrameStackObservation with padding_type='reset'); leave frame_stack out to store observations "
                        "as they are"
                    )

    def stored(self) -> dict[str, np.ndarray]:
        """Returns the arrays of all rows that files hold, by name, ``(n, ...)``; counters follow from ``kind``."""
        obs = {f"obs.{leaf.path or 'array'}": a for leaf, a in zip(self.obs_leaves, self.obs, strict=True)}
        memory = {"memory": self.memory} if self.memory.size else {}
        return {**obs, "action": self.action, "reward": self.reward, "kind": self.kind, **memory}

    def recount(self, head: np.ndarray) -> None:
        """Sets the newest rows to the times ``head``, and counts steps and episodes by the kinds of the rows."""
        self.head = head
        self.n_steps, self.start = np.zeros(self.n_envs, np.int64), np.zeros(self.n_envs, np.int64)
        for env in np.flatnonzero(head >= 0):
            index = self.base[env] + np.arange(max(int(head[env]) - self.rows + 1, 0), head[env] + 1) % self.rows
            kinds_of_rows = self.kind[index]
            self.n_steps[env] = np.count_nonzero(kinds_of_rows[:-1] != LAST)
            since_start, until_end = episode_counters(kinds_of_rows)
            self.start[env] = head[env] - since_start[-1]
            if self.since_start is not None:
                self.since_start[index] = since_start
            if self.until_end is not None:
                self.until_end[index] = until_end


def episode_counters(kinds_of_rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns ``since_start`` and ``until_end`` of successive rows of one environment by their kinds, ``int64 (n,)``.

    The first counts the steps from the row at which the row's episode began, or from the first row given if that is later;
    the second those to the episode's ``LAST`` row, and is 0 where there is none.

    >>> since_start, until_end = episode_counters(np.array([STEP, LAST, STEP, STEP, LAST, STEP, STEP]))
    >>> since_start.tolist(), until_end.tolist()
    ([0, 1, 0, 1, 2, 0, 1], [1, 0, 2, 1, 0, 0, 0])
    """
    places, ends = np.arange(len(kinds_of_rows)), np.flatnonzero(kinds_of_rows == LAST)
    episode = np.searchsorted(ends, places)
    until_end = np.where(episode < len(ends), np.append(ends, 0)[episode] - places, 0)
    return places - np.append(0, ends + 1)[episode], until_end


def stacked_leaves(leaves: tuple[Leaf, ...], frame_stack: int | None) -> tuple[bool, ...]:
    """Returns for each leaf whether it holds ``frame_stack`` frames along its first axis: uint8, of 3 axes or more.

    Goals are stored whole, because hindsight exchanges them one by one.

    Raises:
        ValueError: if ``frame_stack`` is given and there is no such leaf.
    """
    images = [leaf.dtype == "uint8" and len(leaf.shape) >= 3 and leaf.shape[0] == frame_stack for leaf in leaves]
    pairs = zip(images, leaves, strict=True)
    stacked = tuple(is_image and leaf.path not in ("achieved_goal", "desired_goal") for is_image, leaf in pairs)
    if frame_stack is not None and not any(stacked):
        descriptions = ", ".join(f"{leaf.path or 'observation'} {leaf.dtype}{list(leaf.shape)}" for leaf in leaves)
        raise ValueError(
            f"frame_stack={frame_stack} needs uint8 observations ({frame_stack}, height, width[, channels]), got "
            f"{descriptions}; wrap the environment with gymnasium.wrappers.FrameStackObservation(env, {frame_stack})"
        )
    return stacked


def record_dtype(
    leaves: tuple[Leaf, ...],
    stacked: tuple[bool, ...],
    action_shape: tuple[int, ...],
    action_dtype: DTypeLike,
    counters: tuple[str, ...],
) -> np.dtype:
    """Returns the dtype of a row without its kind and frames."""
    fields: list[tuple[Any, ...]] = [("reward", np.float32, ()), ("action", action_dtype, action_shape)]
    fields += [(name, np.int32, ()) for name in counters]
    fields += [(f"obs.{i}", leaf.dtype, leaf.shape) for i, leaf in enumerate(leaves) if not stacked[i]]
    fields.sort(key=lambda field: -np.dtype(field[1]).alignment)  # no gaps except at the end
    return np.dtype(fields, align=True)


def check_memory(nbytes: int, capacity: int, name: str = "buffer_size") -> None:
    """Raises ``MemoryError``, with the numbers, if ``nbytes`` exceed the memory that this process can still get.

    ``name`` is that of the setting with which the user chose ``capacity``.
    """
    memory = free_memory()
    if memory is not None and nbytes > memory:
        fits = int(capacity * 0.5 * memory / nbytes)
        raise MemoryError(
            f"{name}={capacity} takes {nbytes / 2**30:.1f} GiB for this environment and {memory / 2**30:.1f} GiB of memory "
            f"are free; try {name}={fits}"
        )
