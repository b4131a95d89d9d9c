"""Stacks of the last observations."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from gymnasium import spaces

from rejeu.core.types import Info, Observation
from rejeu.sb3.common.vec_env.base_vec_env import TERMINAL_OBSERVATION, by_key, is_image


class StackedObservations:
    """The last ``n_stack`` observations of each environment, oldest first; missing ones at the start of an episode are zeros.

    Args:
        num_envs: number of environments.
        n_stack: number of observations.
        observation_space: Box, or a Dict of them.
        channels_order: ``"first"`` or ``"last"``: the axis along which they are concatenated; None: the first for images
            whose channels come first, else the last. For Dict observations one value for all, or a dict by key.

    Raises:
        TypeError: for other observations.
    """

    def __init__(
        self,
        num_envs: int,
        n_stack: int,
        observation_space: spaces.Space,
        channels_order: str | Mapping[str, str | None] | None = None,
    ) -> None:
        self.n_stack, self.observation_space = n_stack, observation_space
        self._axes: dict[str, int] = {}
        """Axis of one observation along which it is stacked, by key; ``""`` for Box observations."""
        self._stack: dict[str, np.ndarray] = {}
        is_dict = isinstance(observation_space, spaces.Dict)
        parts = observation_space.spaces if isinstance(observation_space, spaces.Dict) else {"": observation_space}
        if isinstance(channels_order, Mapping) and not is_dict:
            raise TypeError(f"channels_order={channels_order!r} must be one value for observations {observation_space}")
        stacked: dict[str, Observation] = {}
        for key, space in parts.items():
            if not isinstance(space, spaces.Box):
                raise TypeError(f"VecFrameStack stacks Box observations, got {space}" + f" under {key!r}" * bool(key))
            order = channels_order.get(key) if isinstance(channels_order, Mapping) else channels_order
            _, _, shape, axis = self.compute_stacking(n_stack, space, order)
            self._axes[key] = axis % len(shape)
            low, high = (np.repeat(bound, n_stack, axis=axis) for bound in (space.low, space.high))
            stacked[key] = spaces.Box(low, high, dtype=space.dtype.type)
            self._stack[key] = np.zeros((num_envs, *shape), space.dtype)
        self.stacked_observation_space = spaces.Dict(stacked) if is_dict else stacked[""]

    @staticmethod
    def compute_stacking(
        n_stack: int, observation_space: spaces.Box, channels_order: str | None = None
    ) -> tuple[bool, int, tuple[int, ...], int]:
        """Returns whether the first axis is stacked, its number in a batch, the shape of a stack, and its number in it."""
        if channels_order not in (None, "first", "last"):
            raise ValueError(f"channels_order={channels_order!r} must be 'first', 'last' or None")
        is_first = channels_order == "first"
        if channels_order is None:
            is_first = is_image(observation_space) and int(np.argmin(observation_space.shape)) == 0
        shape, axis = list(observation_space.shape), 0 if is_first else -1
        shape[axis] *= n_stack
        return is_first, 1 if is_first else -1, tuple(shape), axis

    def reset(self, observation: Observation) -> Observation:
        """Returns the stacks of first observations."""
        self._stack = {key: self._begun(key, newest) for key, newest in by_key(observation).items()}
        return self._stacked()

    def update(self, observations: Observation, dones: np.ndarray, infos: list[Info]) -> tuple[Observation, list[Info]]:
        """Returns the stacks after a step, and the infos, whose ``terminal_observation`` become stacks too."""
        ended = np.flatnonzero(dones).tolist()
        last = {i: by_key(infos[i][TERMINAL_OBSERVATION]) for i in ended if TERMINAL_OBSERVATION in infos[i]}
        final: dict[int, dict[str, np.ndarray]] = {i: {} for i in last}
        for key, newest in by_key(observations).items():
            axis = self._axes[key] + 1
            _, older = np.split(self._stack[key], [newest.shape[axis]], axis)
            for i in last:
                final[i][key] = np.concatenate([older[i], last[i][key]], axis=axis - 1)
            self._stack[key] = np.concatenate([older, newest], axis=axis)
            self._stack[key][ended] = self._begun(key, newest[ended])
        for i, parts in final.items():
            infos[i][TERMINAL_OBSERVATION] = parts.get("", parts)
        return self._stacked(), infos

    def _begun(self, key: str, newest: np.ndarray) -> np.ndarray:
        """Returns the stacks of first observations ``(n, ...)``."""
        missing = [np.zeros_like(newest)] * (self.n_stack - 1)
        return np.concatenate([*missing, newest], axis=self._axes[key] + 1)

    def _stacked(self) -> Observation:
        copies = {key: stack.copy() for key, stack in self._stack.items()}
        return copies.get("", copies)
