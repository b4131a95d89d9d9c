"""A wrapper that stacks the last observations of a vector environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from rejeu.sb3.common.vec_env.base_vec_env import (
    TERMINAL_OBSERVATION,
    StepResult,
    VecEnv,
    VecEnvWrapper,
    by_key,
    is_image,
)

__all__ = ["VecFrameStack"]


class VecFrameStack(VecEnvWrapper):
    """Stacks the last ``n_stack`` observations, oldest first; missing ones at the start of an episode are zeros.

    The ``frame_stack`` option of the agents needs less memory in a replay buffer: it stores each frame once.

    Args:
        venv: a vector environment with Box observations, or a Dict of them.
        n_stack: number of observations.
        channels_order: ``"first"`` or ``"last"``: the axis along which they are concatenated; None: the first for images
            whose channels come first, else the last. For Dict observations one value for all, or a dict by key.
    """

    def __init__(
        self, venv: VecEnv, n_stack: int, channels_order: str | Mapping[str, str | None] | None = None
    ) -> None:
        self.n_stack = n_stack
        space = venv.observation_space
        self._axes: dict[str, int] = {}
        """Axis of one observation along which it is stacked, by key; ``""`` for Box observations."""
        parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
        stacked: dict[str, spaces.Space] = {}
        for key, part in parts.items():
            if not isinstance(part, spaces.Box):
                raise TypeError(f"VecFrameStack stacks Box observations, got {part}" + f" under {key!r}" * bool(key))
            order = channels_order.get(key) if isinstance(channels_order, Mapping) else channels_order
            self._axes[key] = axis = _stack_axis(part, order)
            low, high = (np.repeat(bound, n_stack, axis=axis) for bound in (part.low, part.high))
            stacked[key] = spaces.Box(low, high, dtype=part.dtype.type)
        super().__init__(venv, spaces.Dict(stacked) if isinstance(space, spaces.Dict) else stacked[""])
        self._stack: dict[str, np.ndarray] = {}

    def reset(self) -> Any:
        self._stack = {key: self._begun(key, newest) for key, newest in by_key(self.venv.reset()).items()}
        return self._stacked()

    def step_wait(self) -> StepResult:
        obs, rewards, dones, infos = self.venv.step_wait()
        ended = np.flatnonzero(dones).tolist()
        last = {i: by_key(infos[i][TERMINAL_OBSERVATION]) for i in ended if TERMINAL_OBSERVATION in infos[i]}
        final: dict[int, dict[str, np.ndarray]] = {i: {} for i in last}
        for key, newest in by_key(obs).items():
            axis = self._axes[key] + 1
            _, older = np.split(self._stack[key], [newest.shape[axis]], axis)
            for i in last:
                final[i][key] = np.concatenate([older[i], last[i][key]], axis=axis - 1)
            self._stack[key] = np.concatenate([older, newest], axis=axis)
            self._stack[key][ended] = self._begun(key, newest[ended])
        for i, parts in final.items():
            infos[i][TERMINAL_OBSERVATION] = parts.get("", parts)
        return self._stacked(), rewards, dones, infos

    def _begun(self, key: str, newest: np.ndarray) -> np.ndarray:
        """Returns the stacks of first observations ``(n, ...)``."""
        missing = [np.zeros_like(newest)] * (self.n_stack - 1)
        return np.concatenate([*missing, newest], axis=self._axes[key] + 1)

    def _stacked(self) -> Any:
        copies = {key: stack.copy() for key, stack in self._stack.items()}
        return copies.get("", copies)


def _stack_axis(space: spaces.Box, order: str | None) -> int:
    """Returns the axis along which an observation is stacked."""
    if order not in (None, "first", "last"):
        raise ValueError(f"channels_order={order!r} must be 'first', 'last' or None")
    if order is None:
        first = is_image(space) and int(np.argmin(space.shape)) == 0
        order = "first" if first else "last"
    return 0 if order == "first" else len(space.shape) - 1
