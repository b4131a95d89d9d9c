"""A ring of steps per environment, addressed by absolute time.

Each environment writes one endless row of time steps 0, 1, 2, ...; the ring keeps the newest ``rows`` of them. The row at
time t holds the observation at t and, once the step was taken, its action and reward. The successor of t is the
observation at t + 1, so every observation is stored once. Where an episode ends, one further row holds the final
observation, marked ``LAST``; the next episode begins in the row after it. No row is ever moved.

Of stacked frames (``frame_stack``) a row holds the newest only, and the others are found in the rows before it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from rejeu.buffers.ram import physical_memory
from rejeu.spaces import Leaf, flat_keys

STEP, TERMINATED, LAST = 0, 1, 2
"""Kinds of row: an ordinary step, a step into a terminal state of the MDP, a final observation without a step."""
COUNTERS = ("since_start", "until_end")
"""What a ring can keep of every row beside what the environment said: see :func:`episode_counters`."""


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
        obs_structure: Any,
        action_shape: tuple[int, ...],
        action_dtype: Any,
        frame_stack: int | None = None,
        counters: Sequence[str] = (),
    ) -> None:
        """Reserves ``capacity // n_envs`` rows for each environment (at least 2, and more than ``frame_stack``).

        Images whose first axis has length ``frame_stack`` are taken for as many frames, oldest first. Of ``counters``
        (names of ``COUNTERS``) each takes 4 bytes a row; stacks need ``since_start``, and have it without being asked.

        Raises:
            MemoryError: if the machine cannot hold them, with the numbers.
            ValueError: if ``frame_stack`` is given and no observation leaf is such a stack.
        """
        self.n_envs = n_envs
        self.rows = max(capacity // n_envs, 2, 0 if frame_stack is None else frame_stack + 1)
        self.obs_leaves = obs_leaves
        self.obs_structure = obs_structure
        self.frame_stack = frame_stack
        self.stacked = tuple(is_stack(leaf, frame_stack) for leaf in obs_leaves)
        if frame_stack is not None and not any(self.stacked):
            given = ", ".join(f"{leaf.path or 'observation'} {leaf.dtype}{list(leaf.shape)}" for leaf in obs_leaves)
            raise ValueError(
                f"frame_stack={frame_stack} needs uint8 observations ({frame_stack}, height, width[, channels]), got "
                f"{given}; wrap the environment with gymnasium.wrappers.FrameStackObservation(env, {frame_stack})"
            )
        asked = {*counters, *(() if frame_stack is None else ("since_start",))}
        self.counters = tuple(name for name in COUNTERS if name in asked)
        """Which of ``COUNTERS`` are kept."""
        fields: list[tuple[Any, ...]] = [("reward", np.float32, ()), ("action", action_dtype, action_shape)]
        fields += [(name, np.int32, ()) for name in self.counters]
        fields += [(f"obs.{i}", leaf.dtype, leaf.shape) for i, leaf in enumerate(obs_leaves) if not self.stacked[i]]
        fields.sort(key=lambda field: -np.dtype(field[1]).alignment)  # leaves no gaps but at the end
        record = np.dtype(fields, align=True)
        frames = [leaf.nbytes // leaf.shape[0] for leaf, is_ in zip(obs_leaves, self.stacked, strict=True) if is_]
        n = self.rows * n_envs
        check_memory((record.itemsize + 1 + sum(frames)) * n, capacity)
        self.records = np.zeros(n, record)
        """The rows but for kinds and stacked frames: what is read together, side by side. What follows are views of it."""
        self.obs = [
            np.zeros((n, *leaf.shape[1:]), leaf.dtype) if self.stacked[i] else self.records[f"obs.{i}"]
            for i, leaf in enumerate(obs_leaves)
        ]
        self.action = self.records["action"]
        self.reward = self.records["reward"]
        self.since_start = self.records["since_start"] if "since_start" in asked else None
        """Steps since the row's episode began, or since the oldest row that a file held of it; None if not kept."""
        self.until_end = self.records["until_end"] if "until_end" in asked else None
        """Steps to the ``LAST`` row of the episode; 0 while it runs, and in that row itself; None if not kept."""
        self.kind = np.zeros(n, np.uint8)
        """Apart from the records: it would take 4 bytes of them, and a draw looks at nothing else."""
        self.head = np.full(n_envs, -1, np.int64)
        """Absolute time of each environment's newest row; -1 before the first."""
        self.n_steps = np.zeros(n_envs, np.int64)
        """Steps kept, by environment: the rows that are not ``LAST`` and not the newest."""
        self.start = np.zeros(n_envs, np.int64)
        """Absolute time at which the episode of each environment's newest row began."""
        self.base = np.arange(n_envs, dtype=np.int64) * self.rows
        self._newest = self.base.copy()
        """Positions of the newest rows, by environment."""
        self.all_envs = np.arange(n_envs)
        self._every: slice | int = 0 if n_envs == 1 and frame_stack is None else slice(None)
        """Picks all environments out of an array. For a single one that is a number, with which NumPy is much faster."""
        self.version = 0
        """Rises when rows were replaced otherwise than by being written in turn."""
        self._keys = flat_keys(obs_structure)
        self._names = [f"obs.{i}" for i in range(len(obs_leaves))]

    def __len__(self) -> int:
        """Number of steps that can be sampled."""
        return int(self.n_steps.sum())

    @property
    def nbytes(self) -> int:
        """Bytes reserved."""
        stacks = [array for array, stacked in zip(self.obs, self.stacked, strict=True) if stacked]
        return self.records.nbytes + self.kind.nbytes + sum(array.nbytes for array in stacks)

    def begin(self, obs: Any, envs: np.ndarray | None = None) -> None:
        """Starts an episode with ``obs`` ``(n_envs, ...)`` in the environments ``envs`` (indices; None: all).

        An episode that was still running there is closed where it stands, without a terminal state.
        """
        envs = self.all_envs if envs is None else envs
        for env in envs[self.head[envs] >= 0]:
            self._close(env)
        self._advance(envs)
        self.start[envs] = self.head[envs]
        index = self.index(envs, self.head[envs])
        if self.since_start is not None:
            self.since_start[index] = 0
        self._write_obs(index, obs, envs)

    def add(
        self,
        action: np.ndarray,
        reward: np.ndarray,
        terminated: np.ndarray,
        next_obs: Any,
        envs: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Records one step of each environment in ``envs``; the arrays cover all environments, ``(n_envs, ...)``.

        Returns the positions of the steps and of the rows after them, as numbers if there is a single environment.
        """
        chosen = self._every if envs is None else envs
        index = self._newest[chosen]
        self.action[index] = action[chosen]
        self.reward[index] = reward[chosen]
        self.kind[index] = terminated[chosen]
        following = self._advance(chosen)
        self.n_steps[chosen] += 1
        if self.since_start is not None:
            self.since_start[following] = self.head[chosen] - self.start[chosen]
        self._write_obs(following, next_obs, chosen)
        return index, following

    def index(self, env: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Returns the position in the arrays of rows given by environment and absolute time."""
        return time % self.rows if self.n_envs == 1 else self.base[env] + time % self.rows

    def at(self, env: np.ndarray, time: np.ndarray) -> Rows:
        """Returns the rows of these environments at these absolute times, all ``(n,)``."""
        index = self.index(env, time)
        return Rows(env, time, index, self.kind.take(index))

    def oldest(self) -> np.ndarray:
        """Returns the absolute time of the oldest row that is kept, by environment, ``(n_envs,)``."""
        return np.maximum(self.head - self.rows + 1, 0)

    def draw(self, rng: np.random.Generator, n: int) -> Rows:
        """Returns ``n`` steps drawn uniformly, with replacement, from all that are kept.

        Rows are drawn until they are steps, which takes a second round for the share of ``LAST`` rows only.

        Raises:
            ValueError: if there is none.
        """
        if not np.count_nonzero(self.n_steps):
            raise ValueError("the replay buffer is empty: take some environment steps before sampling from it")
        rows = self._draw_rows(rng, n)
        while LAST in rows.kind.tobytes():  # a search of bytes, much the fastest look at so few
            again = np.flatnonzero(rows.kind == LAST)
            for column, redrawn in zip(rows, self._draw_rows(rng, len(again)), strict=True):
                column[again] = redrawn
        return rows

    def _draw_rows(self, rng: np.random.Generator, n: int) -> Rows:
        if self.n_envs == 1:
            head = int(self.head[0])
            oldest = max(head - self.rows + 1, 0)
            time = (rng.random(n) * (head - oldest)).astype(np.int64)
            if oldest:
                time += oldest
            return self.at(np.zeros(n, np.int64), time)
        ends = np.cumsum(np.maximum(self.head - self.oldest(), 0))
        ticket = (rng.random(n) * ends[-1]).astype(np.int64)
        env = np.searchsorted(ends, ticket, side="right")
        return self.at(env, self.head[env] - 1 - (ends[env] - 1 - ticket))

    def read(self, index: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        """Returns copies of the rows at positions ``index`` as records, and their observation leaves, stacks rebuilt.

        Both have the shape of ``index``; leaves that are no stacks are views of the records. Before an episode's first
        frame a stack repeats it, as ``FrameStackObservation(padding_type="reset")`` does. At the far end of the ring an
        episode counts as begun with the oldest frame that is kept.
        """
        records = self.records.take(index)
        if self.frame_stack is None:
            return records, [records[name] for name in self._names]
        frames = self._frames(index, records["since_start"])
        kinds = zip(self.obs, self.stacked, self._names, strict=True)
        return records, [leaf.take(frames, axis=0) if stacked else records[name] for leaf, stacked, name in kinds]

    def read_leaf(self, leaf: int, index: np.ndarray) -> np.ndarray:
        """Returns one observation leaf, which is no stack, of the rows at positions ``index``; see :meth:`read`."""
        return self.records.take(index)[self._names[leaf]]

    def _frames(self, index: np.ndarray, since_start: np.ndarray) -> np.ndarray:
        """Returns where the frames of the stacks at ``index`` are, oldest first, ``(*index.shape, frame_stack)``."""
        assert self.frame_stack is not None
        env, slot = np.divmod(index, self.rows)
        head = self.head[env]
        since_oldest = np.minimum(head, self.rows - 1) - (head - slot) % self.rows
        available = np.minimum(since_oldest, since_start)
        back = np.minimum(np.arange(self.frame_stack)[::-1], available[..., None])
        return self.base[env][..., None] + (slot[..., None] - back) % self.rows

    def tree(self, obs_leaves: Sequence[Any]) -> Any:
        """Returns observation leaves in the nesting of the environment's space."""
        return jax.tree.unflatten(self.obs_structure, obs_leaves)

    def _advance(self, envs: np.ndarray | slice | int) -> np.ndarray:
        """Moves the heads on by one row, forgetting what stood there, and returns the positions of the new rows."""
        head = self.head[envs] + 1
        self.head[envs] = head
        index = self.base[envs] + head % self.rows
        if isinstance(envs, slice):
            self._newest = index
        else:
            self._newest[envs] = index
        full = head >= self.rows
        if full if isinstance(envs, int) else np.count_nonzero(full):
            self.n_steps[envs] -= full & (self.kind[index] != LAST)
        self.kind[index] = STEP
        if self.until_end is not None:
            self.until_end[index] = 0
        return index

    def _close(self, env: int) -> None:
        """Marks the newest row of ``env`` as its episode's final observation."""
        head = int(self.head[env])
        self.kind[int(self.base[env]) + head % self.rows] = LAST
        if self.until_end is not None:
            times = np.arange(max(int(self.start[env]), head - self.rows + 1), head + 1)
            self.until_end[self.base[env] + times % self.rows] = head - times

    def _write_obs(self, index: np.ndarray, obs: Any, envs: np.ndarray | slice | int) -> None:
        """Writes observations ``(n_envs, ...)`` at ``index``, of stacks the newest frame.

        Raises:
            ValueError: if the older frames of a stack are not those of the rows before, so that it cannot be rebuilt.
        """
        leaves = jax.tree.leaves(obs) if self._keys is None else [obs[key] for key in self._keys]
        for store, leaf, stacked in zip(self.obs, leaves, self.stacked, strict=True):
            store[index] = leaf[envs, -1] if stacked else leaf[envs]
        if self.frame_stack is None:
            return
        # A run may begin an episode in the ring midway, whose older frames are then padded like those of any other; the
        # first that an environment ever begins does follow a reset, and shows how its stacks are padded.
        length = np.where(self.head[envs] == 0, self.frame_stack, self.head[envs] - self.start[envs] + 1)
        for rebuilt, leaf, stacked in zip(self.read(index)[1], leaves, self.stacked, strict=True):
            if stacked:
                differs = (rebuilt != leaf[envs]).any(axis=tuple(range(2, leaf.ndim)))
                if (differs[:, ::-1] & (np.arange(leaf.shape[1]) < length[:, None])).any():
                    raise ValueError(
                        f"frame_stack={self.frame_stack}: an observation is not made of the frames of the steps before "
                        "it, oldest first, the episode's first one repeated (gymnasium.wrappers.FrameStackObservation "
                        "with padding_type='reset'); leave frame_stack out to store observations as they are"
                    )

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns everything kept as named arrays, the untouched rows left out: ``(n_envs, rows used, ...)``.

        The counters of rows are left out; they follow from ``kind``.
        """
        used = int(min(self.head.max() + 1, self.rows))
        split = lambda a: a.reshape(self.n_envs, self.rows, *a.shape[1:])[:, :used]  # noqa: E731
        stored = {name: split(array) for name, array in self._stored().items()}
        return stored | {"head": self.head, "n_steps": self.n_steps}

    def _stored(self) -> dict[str, np.ndarray]:
        """Returns what files hold of every row, by its name there, ``(n, ...)``."""
        obs = {f"obs.{leaf.path or 'array'}": a for leaf, a in zip(self.obs_leaves, self.obs, strict=True)}
        return {**obs, "action": self.action, "reward": self.reward, "kind": self.kind}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Puts back what :meth:`arrays` returned; everything is checked before anything is changed.

        Arrays of ``COUNTERS``, which older files hold, are checked and then counted anew.

        Raises:
            ValueError: if names, shapes or dtypes are not those of this ring.
        """
        self.check(arrays)
        own = self._stored()
        counters = {name: arrays[name] for name in COUNTERS if name in arrays}
        head, n_steps = arrays["head"], arrays["n_steps"]
        used = arrays["kind"].shape[1]
        if head.min() < -1 or head.max() >= 2**62 or used != min(head.max() + 1, self.rows):
            raise ValueError("the replay file's counters are damaged")
        for name in ("action", "reward"):
            if not np.isfinite(arrays[name]).all():
                raise ValueError(f"{name} in the replay file holds what is not finite, which no environment may return")
        if not self._consistent(head, n_steps, arrays["kind"], counters):
            raise ValueError("the replay file's counters are damaged")
        for name, array in own.items():
            array.reshape(self.n_envs, self.rows, *array.shape[1:])[:, :used] = arrays[name]
        self._stand(head.copy())

    def check(self, found: Mapping[str, Any]) -> None:
        """Checks that arrays, or their specs, can be what :meth:`arrays` returned of a ring like this one.

        Raises:
            ValueError: if names, shapes or dtypes are others, or there are more rows than this ring has.
        """
        own = self._stored()
        counters = {*COUNTERS} if {*COUNTERS} <= {*found} else set()
        if differing := {*found} ^ {*own, *counters, "head", "n_steps"}:
            raise ValueError(
                f"the replay file and this buffer differ in the arrays {', '.join(sorted(differing))[:200]}"
            )
        head, n_steps = found["head"], found["n_steps"]
        if head.shape != (self.n_envs,) or n_steps.shape != (self.n_envs,):
            raise ValueError(
                f"the replay file is of {head.size} environments and this agent has {self.n_envs}; make them equal"
            )
        if head.dtype != np.int64 or n_steps.dtype != np.int64:
            raise ValueError("the replay file's counters are damaged")
        n_envs, used = self.n_envs, min((*found["kind"].shape, 0, 0)[1], self.rows)
        expected = {name: ((n_envs, used, *array.shape[1:]), array.dtype) for name, array in own.items()}
        expected |= dict.fromkeys(counters, ((n_envs, used), np.dtype(np.int32)))
        for name, (shape, dtype) in expected.items():
            if found[name].shape != shape or found[name].dtype != dtype:
                raise ValueError(
                    f"{name} in the replay file is {found[name].dtype}{list(found[name].shape)} and this buffer expects "
                    f"{dtype}{list(shape)}; it was saved with another environment or buffer_size"
                )

    def rows_since(self, heads: np.ndarray) -> dict[str, np.ndarray]:
        """Returns the rows from those that were the newest at ``heads`` on, ``(n, ...)``, environment after environment.

        The row at a head is among them: its action and reward came later. With ``-1`` for every head these are all rows.
        The counters of rows are left out; they follow from ``kind``.
        """
        first = np.maximum(heads, self.oldest())
        spans = [np.arange(first[env], self.head[env] + 1) for env in range(self.n_envs)]
        index = np.concatenate([self.index(np.full(len(span), env), span) for env, span in enumerate(spans)])
        rows = {name: array[index] for name, array in self._stored().items()}
        return rows | {"first": first, "head": self.head.copy()}

    def put_rows(self, parts: Sequence[Mapping[str, np.ndarray]]) -> None:
        """Puts back what :meth:`rows_since` returned in turn, each beginning where the one before ended, or earlier.

        An array ``since_start``, which older files hold, is passed over.

        Raises:
            ValueError: if they are of another ring, or something between them is missing; the ring is then empty.
        """
        self._stand(np.full(self.n_envs, -1, np.int64))
        own = self._stored()
        known = newest = self.head
        for rows in parts:
            self.check_rows(rows)
            first, head = rows["first"], rows["head"]
            if not ((head >= first - 1) & (head - first < self.rows) & (first >= 0) & (head < 2**62)).all():
                raise ValueError("rows of the replay buffer have damaged counters")
            n = int((head - first + 1).sum())
            if len(rows["kind"]) != n:
                raise ValueError(f"rows of the replay buffer are {len(rows['kind'])}, and {n} by their counters")
            if rows["kind"].max(initial=0) > LAST:
                raise ValueError("rows of the replay buffer have damaged kinds")
            if not (np.isfinite(rows["action"]).all() and np.isfinite(rows["reward"]).all()):
                raise ValueError("rows of the replay buffer have actions or rewards that are not finite")
            spans = [np.arange(first[env], head[env] + 1) for env in range(self.n_envs)]
            index = np.concatenate([self.index(np.full(len(span), env), span) for env, span in enumerate(spans)])
            for name, array in own.items():
                array[index] = rows[name]
            known, newest = np.where(first > newest, first, np.minimum(known, first)), head
        if ((newest >= 0) & (known > np.maximum(newest - self.rows + 1, 0))).any():
            raise ValueError("rows of the replay buffer are missing")
        self._stand(newest.copy())

    def check_rows(self, found: Mapping[str, Any]) -> None:
        """Checks that arrays, or their specs, can be what :meth:`rows_since` returned.

        Raises:
            ValueError: if names, shapes or dtypes are others, or there are more rows than the ring has.
        """
        own = self._stored()
        if {*found} - {"since_start"} != {*own, "first", "head"}:
            raise ValueError(
                f"rows of the replay buffer hold {', '.join(sorted(found))[:200]}, expected "
                f"{', '.join(sorted({*own, 'first', 'head'}))}"
            )
        n = found["kind"].shape[0] if found["kind"].shape else 0
        expected = {name: ((n, *array.shape[1:]), array.dtype) for name, array in own.items()}
        expected |= dict.fromkeys(("first", "head"), ((self.n_envs,), np.dtype(np.int64)))
        if "since_start" in found:
            expected["since_start"] = ((n,), np.dtype(np.int32))
        for name, (shape, dtype) in expected.items():
            if found[name].shape != shape or found[name].dtype != dtype:
                raise ValueError(
                    f"{name} in rows of the replay buffer is {found[name].dtype}{list(found[name].shape)}, expected "
                    f"{dtype}{list(shape)}; it was saved with another environment or buffer_size"
                )
        if n > self.rows * self.n_envs:
            raise ValueError(f"there are {n:,} rows, and the replay buffer has {self.rows * self.n_envs:,}")

    def _stand(self, head: np.ndarray) -> None:
        """Takes the rows up to the times ``head`` for what is kept, and counts steps and episodes by their kinds."""
        self.head = head
        self.n_steps, self.start = np.zeros(self.n_envs, np.int64), np.zeros(self.n_envs, np.int64)
        for env in np.flatnonzero(head >= 0):
            index = self.base[env] + np.arange(max(int(head[env]) - self.rows + 1, 0), head[env] + 1) % self.rows
            kind = self.kind[index]
            self.n_steps[env] = np.count_nonzero(kind[:-1] != LAST)
            since_start, until_end = episode_counters(kind)
            self.start[env] = head[env] - since_start[-1]
            if self.since_start is not None:
                self.since_start[index] = since_start
            if self.until_end is not None:
                self.until_end[index] = until_end
        self._newest = self.base + self.head % self.rows
        self.version += 1

    def _consistent(
        self, head: np.ndarray, n_steps: np.ndarray, kind: np.ndarray, counters: Mapping[str, np.ndarray]
    ) -> bool:
        """Whether the numbers of a file agree with each other, so that nothing drawn by them lies outside the ring."""
        for env in range(self.n_envs):
            times = np.arange(max(head[env] - self.rows + 1, 0), head[env] + 1)
            rows = times % self.rows
            if kind[env, rows].max(initial=0) > LAST or n_steps[env] != (kind[env, rows[:-1]] != LAST).sum():
                return False
            if counters:
                since_start, until_end = (counters[name][env, rows] for name in COUNTERS)
                begins, ends = times - since_start, times + until_end
                if not ((begins >= 0) & (begins <= times) & (ends >= times) & (ends <= head[env])).all():
                    return False
        return True


def episode_counters(kind: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns ``since_start`` and ``until_end`` of successive rows of one environment by their kinds, ``int64 (n,)``.

    The first counts the steps from the row at which the row's episode began, or from the first row given if that is later;
    the second those to the episode's ``LAST`` row, and is 0 where there is none.

    >>> since_start, until_end = episode_counters(np.array([STEP, LAST, STEP, STEP, LAST, STEP, STEP]))
    >>> since_start.tolist(), until_end.tolist()
    ([0, 1, 0, 1, 2, 0, 1], [1, 0, 2, 1, 0, 0, 0])
    """
    places, ends = np.arange(len(kind)), np.flatnonzero(kind == LAST)
    episode = np.searchsorted(ends, places)
    until_end = np.where(episode < len(ends), np.append(ends, 0)[episode] - places, 0)
    return places - np.append(0, ends + 1)[episode], until_end


def is_stack(leaf: Leaf, frame_stack: int | None) -> bool:
    """Returns whether a leaf holds ``frame_stack`` frames along its first axis: uint8, of 3 axes or more, and no goal.

    Hindsight exchanges goals one by one, so they are stored whole.
    """
    is_goal = leaf.path in ("achieved_goal", "desired_goal")
    return leaf.dtype == "uint8" and len(leaf.shape) >= 3 and leaf.shape[0] == frame_stack and not is_goal


def check_memory(nbytes: int, capacity: int, name: str = "buffer_size") -> None:
    """Raises ``MemoryError``, with the numbers, if ``nbytes`` exceed the machine's physical memory.

    ``name`` is that of the setting with which the user chose ``capacity``.
    """
    memory = physical_memory()
    if memory is not None and nbytes > memory:
        fits = int(capacity * 0.5 * memory / nbytes)
        raise MemoryError(
            f"{name}={capacity} takes {nbytes / 2**30:.1f} GiB for this environment and the machine has "
            f"{memory / 2**30:.1f} GiB; try {name}={fits}"
        )
