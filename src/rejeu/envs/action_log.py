"""The log of the actions of environments that do not expose their state, but are deterministic given seed and actions.

They are restored by replaying the log of all actions and resets since their creation. A log is a sequence of operations:
a step of all environments, a step of some, a reset of all, or a reset of some. An operation is stored as one byte for its
kind, one bit per environment if it concerns only some, and the actions. Blocks of about a megabyte are compressed.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from itertools import islice
from typing import NamedTuple

import gymnasium as gym
import numpy as np

from rejeu.core.spaces import action_scaler, check_env_actions, random_action
from rejeu.core.types import JsonObject
from rejeu.core.validation import whole

STEP, STEP_SOME, RESET, RESET_SOME = range(4)
BLOCK = 2**20
"""Size of a block before compression, in bytes."""
MOST_STEPS = 500_000
"""Environment steps after which a log is full. Replaying takes 10 to 60 microseconds per step."""
MOST_IMAGE_STEPS = 100_000
"""Environment steps after which a log with image observations is full. Replaying one takes about ten times as long."""
MOST_BYTES = 2**24
"""Bytes of actions after which a log is full, regardless of the number of steps."""
MANY_OPERATIONS = 20_000
"""Number of operations from which a progress bar is shown during replay."""


class LoggedOperation(NamedTuple):
    """One step or reset of the environments."""

    indices: np.ndarray | None
    """Indices of the environments, ``int32 (k,)``; None for all."""
    action: np.ndarray | None
    """Their actions ``(k, ...)`` in the range of the action space; None for a reset."""


class ActionLog:
    """The operations on ``n_envs`` environments since their creation. Mutable."""

    def __init__(self, n_envs: int, action_space: gym.Space, most_steps: int = MOST_STEPS, is_on: bool = True) -> None:
        self.n_envs = n_envs
        self.is_on = is_on
        """Whether operations are recorded."""
        self.is_complete = True
        """Whether all operations were recorded."""
        self.n_steps = 0
        """Number of steps, summed over the environments."""
        self.n_operations = 0
        example = action_scaler(action_space)(random_action(action_space, 1, np.random.default_rng(0)))
        self._space, self._dtype, self._shape = action_space, example.dtype, example.shape[1:]
        self._row_bytes = example.nbytes
        self._most_steps = min(most_steps, MOST_BYTES // max(self._row_bytes, 1))
        self._blocks: list[np.ndarray] = []
        self._open = bytearray()

    @property
    def most_operations(self) -> int:
        """Maximum number of operations of a log: steps of single environments, each followed by a reset."""
        return 4 * self._most_steps + 2

    @property
    def is_full(self) -> bool:
        """Whether the log is so long that a replay would take too much time."""
        return self.n_steps >= self._most_steps

    def step(self, action: np.ndarray, indices: np.ndarray | None = None) -> np.ndarray:
        """Records a step and returns the actions as they are recorded, ``(k, ...)``.

        Args:
            action: actions of all environments, or of those in ``indices``.
            indices: indices of the environments that are stepped; None for all.
        """
        rows = self.n_envs if indices is None else len(indices)
        action = np.ascontiguousarray(action, self._dtype).reshape(rows, *self._shape)
        self._add(STEP if indices is None else STEP_SOME, indices, action.tobytes())
        self.n_steps += rows
        return action

    def reset(self, indices: np.ndarray | None = None) -> None:
        """Records a reset of all environments, or of those in ``indices``."""
        self._add(RESET if indices is None else RESET_SOME, indices, b"")

    def _add(self, operation: int, indices: np.ndarray | None, action: bytes) -> None:
        self.is_complete &= self.is_on
        if not self.is_complete:
            return
        self.n_operations += 1
        self._open.append(operation)
        if indices is not None:
            flags = np.zeros(self.n_envs, bool)
            flags[indices] = True
            self._open += np.packbits(flags).tobytes()
        self._open += action
        if len(self._open) >= BLOCK:
            self._blocks.append(_compressed(self._open))
            self._open = bytearray()

    def to_plain(self) -> JsonObject:
        """Returns the log as plain data (see :mod:`rejeu.core.records`)."""
        return {"n_operations": self.n_operations, "blocks": [*self._blocks, _compressed(self._open)]}

    def operations(self, saved: JsonObject) -> Iterator[LoggedOperation]:
        """Yields the operations of a log that :meth:`to_plain` returned, oldest first.

        Raises:
            ValueError: if the log is corrupted, or belongs to other environments.
        """
        n_flags = (self.n_envs + 7) // 8
        longest = BLOCK + 1 + n_flags + self.n_envs * self._row_bytes
        for block in saved["blocks"]:
            data, at = _expanded(block, longest), 0
            while at < len(data):
                operation = data[at]
                at += 1
                if operation > RESET_SOME:
                    raise ValueError(f"{operation} is no kind of operation")
                indices = None
                if operation in (STEP_SOME, RESET_SOME):
                    flags = np.unpackbits(_part(data, at, n_flags).view(np.uint8), count=self.n_envs)
                    indices = np.flatnonzero(flags).astype(np.int32)
                    at += n_flags
                action = None
                if operation in (STEP, STEP_SOME):
                    rows = self.n_envs if indices is None else len(indices)
                    action = _part(data, at, rows * self._row_bytes).view(self._dtype).reshape(rows, *self._shape)
                    check_env_actions(self._space, action, "the record of actions")
                    at += rows * self._row_bytes
                yield LoggedOperation(indices, action)


def replay(log: ActionLog, saved: JsonObject, title: str) -> Iterator[LoggedOperation]:
    """Yields the operations of a saved log. On a terminal, a progress bar is shown for long logs.

    Raises:
        ValueError: if the log is corrupted.
    """
    from rich.console import Console  # not loaded with every model
    from rich.progress import track

    n = whole("n_operations", saved["n_operations"], least=0, most=log.most_operations)
    console = Console(stderr=True)
    hidden = n < MANY_OPERATIONS or not (console.is_terminal or console.is_jupyter)
    operations = log.operations(saved)
    text = f"Replaying {title}"
    yield from islice(track(operations, text, total=n, console=console, transient=True, disable=hidden), n)
    if log.n_operations != n or next(operations, None) is not None:
        raise ValueError(f"the record of actions does not hold the {n} operations that it should")


def _compressed(data: bytearray) -> np.ndarray:
    return np.frombuffer(zlib.compress(bytes(data), 1), np.uint8)


def _expanded(block: object, longest: int) -> bytes:
    """Returns the decompressed bytes of a block, at most ``longest``."""
    if not isinstance(block, np.ndarray) or block.dtype != np.uint8 or block.ndim != 1:
        raise ValueError("a block of the record of actions is no array of bytes")
    reader = zlib.decompressobj()
    try:
        data = reader.decompress(block.tobytes(), longest)
    except zlib.error as error:
        raise ValueError(f"a block of the record of actions is damaged: {error}") from None
    if not reader.eof:
        raise ValueError("a block of the record of actions is too long or cut short")
    return data


def _part(data: bytes, at: int, n: int) -> np.ndarray:
    if at + n > len(data):
        raise ValueError("the record of actions is cut short")
    return np.frombuffer(data, np.uint8, n, at).copy()
