"""The log of the actions of environments that do not expose their state, but are deterministic given seed and actions.

They are restored by replaying the log of all actions and resets since their creation. A log is a sequence of operations:
a step of all environments, a step of some, a reset of all, or a reset of some. Stored are one byte for the kind of each, one
bit per environment if it concerns only some, and the actions.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import gymnasium as gym
import numpy as np

from rejeu.core.spaces import action_scaler, check_env_actions, random_action
from rejeu.core.types import JsonObject
from rejeu.core.validation import whole

STEP, STEP_SOME, RESET, RESET_SOME = range(4)
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
        example = action_scaler(action_space)(random_action(action_space, 1, np.random.default_rng(0)))
        self._space, self._dtype, self._shape = action_space, example.dtype, example.shape[1:]
        self._most_steps = min(most_steps, MOST_BYTES // max(example.nbytes, 1))
        self._codes, self._flags, self._actions = bytearray(), bytearray(), bytearray()

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

    def _add(self, code: int, indices: np.ndarray | None, action: bytes) -> None:
        self.is_complete &= self.is_on
        if not self.is_complete:
            return
        self._codes.append(code)
        if indices is not None:
            flags = np.zeros(self.n_envs, bool)
            flags[indices] = True
            self._flags += np.packbits(flags).tobytes()
        self._actions += action

    def to_plain(self) -> dict[str, np.ndarray]:
        """Returns the log as plain data (see :mod:`rejeu.core.records`)."""
        actions = np.frombuffer(bytes(self._actions), self._dtype).reshape(-1, *self._shape)
        codes, flags = (np.frombuffer(bytes(content), np.uint8) for content in (self._codes, self._flags))
        return {"codes": codes, "flags": flags.reshape(-1, (self.n_envs + 7) // 8), "actions": actions}

    def operations(self, saved: JsonObject) -> Iterator[LoggedOperation]:
        """Yields the operations of a log that :meth:`to_plain` returned, oldest first.

        Raises:
            ValueError: if the log is corrupted, or belongs to other environments.
        """
        for name, empty in ActionLog(self.n_envs, self._space).to_plain().items():
            array = np.asarray(saved[name])
            if array.dtype != empty.dtype or array.ndim != empty.ndim or array.shape[1:] != empty.shape[1:]:
                raise ValueError(
                    f"the {name} in the record of actions are not those of {self.n_envs} such environments"
                )
        codes, flags, actions = saved["codes"], iter(saved["flags"]), saved["actions"]
        whole("the number of operations in the record of actions", len(codes), least=0, most=self.most_operations)
        check_env_actions(self._space, actions, "the record of actions")
        is_some, at = np.isin(codes, (STEP_SOME, RESET_SOME)), 0
        if is_some.sum() != len(saved["flags"]) or codes.max(initial=0) > RESET_SOME:
            raise ValueError("the record of actions holds an operation that is none, or says not whom one concerns")
        for code, concerns_some in zip(codes.tolist(), is_some.tolist(), strict=True):
            indices = action = None
            if concerns_some:
                indices = np.flatnonzero(np.unpackbits(next(flags), count=self.n_envs)).astype(np.int32)
            if code in (STEP, STEP_SOME):
                n_rows = self.n_envs if indices is None else len(indices)
                action, at = actions[at : at + n_rows], at + n_rows
                if at > len(actions):
                    break
            yield LoggedOperation(indices, action)
        if at != len(actions):
            raise ValueError(f"the record of actions has {len(actions)} rows of actions, expected {at}")


def replay(log: ActionLog, saved: JsonObject, title: str) -> Iterator[LoggedOperation]:
    """Yields the operations of a saved log. On a terminal, a progress bar is shown for long logs.

    Raises:
        ValueError: if the log is corrupted.
    """
    from rich.console import Console  # not loaded with every model
    from rich.progress import track

    n, console = np.size(saved["codes"]), Console(stderr=True)
    hidden = n < MANY_OPERATIONS or not (console.is_terminal or console.is_jupyter)
    text = f"Replaying {title}"
    yield from track(log.operations(saved), text, total=n, console=console, transient=True, disable=hidden)
