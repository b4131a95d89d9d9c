"""What can be put around a vector environment: stacked frames, a monitor, images turned round, a watch for NaN."""

from __future__ import annotations

import csv
import json
import time
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from rejeu.envs.monitor import Monitor, csv_line, monitor_path
from rejeu.envs.vec_env import StepResult, VecEnv, VecEnvWrapper
from rejeu.errors import BadEnvironmentError
from rejeu.io import atomic
from rejeu.io.failed_writes import FailedWrites

LAST = "terminal_observation"


class VecFrameStack(VecEnvWrapper):
    """Shows the last ``n_stack`` observations as one, oldest first; before an episode's first there are zeros.

    For replay buffers ``frame_stack`` of the agent takes less memory: it stores each frame once.

    Args:
        venv: a vector environment with Box observations, or a Dict of them.
        n_stack: how many.
        channels_order: ``"first"`` or ``"last"``: the axis along which they are put together; None: the first for images
            whose channels come first, else the last. For Dict observations a dict of these by key, or one for all.
    """

    def __init__(
        self, venv: VecEnv, n_stack: int, channels_order: str | Mapping[str, str | None] | None = None
    ) -> None:
        self.n_stack = n_stack
        space = venv.observation_space
        self._axes: dict[str, int] = {}
        """By key, ``""`` for a plain Box: the axis of stacking in one observation."""
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
        """Resets the environments and returns the stacked observations."""
        obs = _by_key(self.venv.reset())
        for key, newest in obs.items():
            width = newest.shape[self._axes[key] + 1]
            shape = list(newest.shape)
            shape[self._axes[key] + 1] = width * self.n_stack
            self._stack[key] = np.zeros(shape, newest.dtype)
            self._put(key, slice(None), newest)
        return self._shown()

    def step_wait(self) -> StepResult:
        """Steps the environments and returns stacked observations, rewards, dones and infos."""
        obs, rewards, dones, infos = self.venv.step_wait()
        ended = np.flatnonzero(dones).tolist()
        last = {i: _by_key(infos[i][LAST]) for i in ended if LAST in infos[i]}
        shown: dict[int, dict[str, np.ndarray]] = {i: {} for i in last}
        for key, newest in _by_key(obs).items():
            axis = self._axes[key] + 1
            width = newest.shape[axis]
            older = _cut(self._stack[key], axis, width, None)
            for i in last:
                shown[i][key] = np.concatenate([older[i], last[i][key]], axis=axis - 1)
            self._stack[key] = np.concatenate([older, newest], axis=axis)
            for i in ended:
                self._stack[key][i] = 0
                self._put(key, slice(i, i + 1), newest[i : i + 1])
        for i, parts in shown.items():
            infos[i][LAST] = parts.get("", parts)
        return self._shown(), rewards, dones, infos

    def _put(self, key: str, rows: slice, newest: np.ndarray) -> None:
        axis = self._axes[key] + 1
        _cut(self._stack[key][rows], axis, -newest.shape[axis], None)[...] = newest

    def _shown(self) -> Any:
        copies = {key: stack.copy() for key, stack in self._stack.items()}
        return copies.get("", copies)


class VecMonitor(VecEnvWrapper):
    """Adds ``info["episode"] = {"r": return, "l": length, "t": seconds since construction}`` to an episode's last step.

    Args:
        venv: the vector environment.
        filename: of a CSV file as :class:`rejeu.Monitor` writes it; None writes none.
        info_keywords: entries of the last step's info to write down with the episode.
    """

    EXT = Monitor.EXT

    def __init__(self, venv: VecEnv, filename: str | Path | None = None, info_keywords: Sequence[str] = ()) -> None:
        super().__init__(venv)
        self.t_start = time.time()
        self.info_keywords = tuple(info_keywords)
        self.episode_count = 0
        self.episode_returns = np.zeros(self.num_envs)
        self.episode_lengths = np.zeros(self.num_envs, np.int64)
        self.path = None if filename is None else monitor_path(filename)
        self._failed_writes = FailedWrites()
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("w", newline="\n", encoding="utf-8") as file:
                file.write(f"#{json.dumps({'t_start': self.t_start, 'env_id': None})}\n")
                csv.writer(file).writerow(("r", "l", "t", *self.info_keywords))

    def close(self) -> None:
        """Closes the environments, after a last attempt at rows that could not be written."""
        self._failed_writes.retry()
        self._failed_writes.warn()
        super().close()

    def reset(self) -> Any:
        """Resets the environments and returns the observations."""
        self.episode_returns = np.zeros(self.num_envs)
        self.episode_lengths = np.zeros(self.num_envs, np.int64)
        return self.venv.reset()

    def step_wait(self) -> StepResult:
        """Steps the environments and returns observations, rewards, dones and infos."""
        obs, rewards, dones, infos = self.venv.step_wait()
        self.episode_returns += rewards
        self.episode_lengths += 1
        infos = list(infos)
        for i in np.flatnonzero(dones).tolist():
            infos[i] = {**infos[i], "episode": self._end_episode(i, infos[i])}
        return obs, rewards, dones, infos

    def _end_episode(self, i: int, info: dict[str, Any]) -> dict[str, Any]:
        row = {
            "r": float(self.episode_returns[i]),
            "l": int(self.episode_lengths[i]),
            "t": round(time.time() - self.t_start, 6),
        }
        for key in self.info_keywords:
            if key not in info:
                raise ValueError(f"info_keywords: the info of an episode's last step has no {key!r}, only {[*info]}")
            row[key] = info[key]
        self.episode_count += 1
        self.episode_returns[i] = self.episode_lengths[i] = 0
        if self.path is not None:
            line = csv_line(row, ("r", "l", "t", *self.info_keywords))
            self._failed_writes.put(f"rows of {self.path}", partial(atomic.append, self.path), line)
        return row


class VecTransposeImage(VecEnvWrapper):
    """Shows images with their channels first: ``(height, width, channels)`` becomes ``(channels, height, width)``.

    rejeu's networks take either order; this is for scripts that look at the observations.

    Args:
        venv: a vector environment with image observations, or a Dict with some.
        skip: show them as they are.
    """

    def __init__(self, venv: VecEnv, skip: bool = False) -> None:
        self.skip = skip
        space = venv.observation_space
        parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
        self._keys = [] if skip else [key for key, part in parts.items() if _is_image(part)]
        if not skip and not self._keys:
            raise ValueError(f"VecTransposeImage found no uint8 image of three axes in {space}")
        turned = {key: self.transpose_space(part) if key in self._keys else part for key, part in parts.items()}
        super().__init__(venv, spaces.Dict(turned) if isinstance(space, spaces.Dict) else turned[""])

    @staticmethod
    def transpose_space(observation_space: spaces.Space, key: str = "") -> spaces.Box:
        """Returns the space of the turned images; ``key`` is accepted and not looked at."""
        assert isinstance(observation_space, spaces.Box)
        low, high = (np.moveaxis(bound, -1, 0) for bound in (observation_space.low, observation_space.high))
        return spaces.Box(low, high, dtype=observation_space.dtype.type)

    @staticmethod
    def transpose_image(image: np.ndarray) -> np.ndarray:
        """Returns an image or a batch of them with the channels first."""
        return np.moveaxis(image, -1, -3)

    def transpose_observations(self, observations: Any) -> Any:
        """Returns observations, one or a batch, with their images turned."""
        parts = _by_key(observations)
        turned = {key: self.transpose_image(part) if key in self._keys else part for key, part in parts.items()}
        return turned.get("", turned)

    def reset(self) -> Any:
        """Resets the environments and returns the turned observations."""
        return self.transpose_observations(self.venv.reset())

    def step_wait(self) -> StepResult:
        """Steps the environments and returns turned observations, rewards, dones and infos."""
        obs, rewards, dones, infos = self.venv.step_wait()
        for info in infos:
            if LAST in info:
                info[LAST] = self.transpose_observations(info[LAST])
        return self.transpose_observations(obs), rewards, dones, infos


class VecExtractDictObs(VecEnvWrapper):
    """Shows one part of Dict observations.

    Args:
        venv: a vector environment with Dict observations.
        key: which.
    """

    def __init__(self, venv: VecEnv, key: str) -> None:
        space = venv.observation_space
        if not isinstance(space, spaces.Dict) or key not in space.spaces:
            raise ValueError(f"the observations are {space} and have no {key!r}")
        super().__init__(venv, space[key])
        self.key = key

    def reset(self) -> np.ndarray:
        """Resets the environments and returns that part of the observations."""
        return self.venv.reset()[self.key]

    def step_wait(self) -> StepResult:
        """Steps the environments and returns that part of the observations, rewards, dones and infos."""
        obs, rewards, dones, infos = self.venv.step_wait()
        for info in infos:
            if LAST in info:
                info[LAST] = info[LAST][self.key]
        return obs[self.key], rewards, dones, infos


class VecCheckNan(VecEnvWrapper):
    """Looks at every action, observation and reward and says where the first NaN or infinity comes from.

    Args:
        venv: the vector environment.
        raise_exception: raise; False warns.
        warn_once: warn of the first only.
        check_inf: look for infinities too.
    """

    def __init__(
        self, venv: VecEnv, raise_exception: bool = False, warn_once: bool = True, check_inf: bool = True
    ) -> None:
        super().__init__(venv)
        self.raise_exception, self.warn_once, self.check_inf = raise_exception, warn_once, check_inf
        self._warned = False
        self._before: Any = None
        """The last actions, None after a reset."""

    def step_async(self, actions: Any) -> None:
        """Begins a step with one action for each environment."""
        self._look(actions, "the actions")
        self._before = actions
        self.venv.step_async(actions)

    def reset(self) -> Any:
        """Resets the environments and returns the observations."""
        obs = self.venv.reset()
        self._before = None
        self._look(obs, "the observations of reset")
        return obs

    def step_wait(self) -> StepResult:
        """Steps the environments and returns observations, rewards, dones and infos."""
        obs, rewards, dones, infos = self.venv.step_wait()
        self._look(obs, "the observations")
        self._look(rewards, "the rewards")
        return obs, rewards, dones, infos

    def _look(self, values: Any, what: str) -> None:
        if self._warned and self.warn_once and not self.raise_exception:
            return
        for key, value in _by_key(values).items():
            array = np.asarray(value)
            if array.dtype.kind != "f":
                continue
            bad = ~np.isfinite(array) if self.check_inf else np.isnan(array)
            if bad.any():
                where = tuple(int(i) for i in np.argwhere(bad)[0])
                after = "" if self._before is None or what == "the actions" else f" after the actions {self._before}"
                message = f"{what}{f' under {key!r}' * bool(key)} hold {array[where]} at {where}{after}"
                if self.raise_exception:
                    raise BadEnvironmentError(message)
                self._warned = True
                warnings.warn(message, UserWarning, stacklevel=3)


def _by_key(obs: Any) -> dict[str, Any]:
    """Returns the parts of an observation by key; a plain one has the key ``""``."""
    return obs if isinstance(obs, dict) else {"": obs}


def _cut(array: np.ndarray, axis: int, start: int, stop: int | None) -> np.ndarray:
    """Returns a view of ``array[..., start:stop, ...]`` along one axis."""
    return array[(slice(None),) * axis + (slice(start, stop),)]


def _is_image(space: spaces.Space) -> bool:
    return isinstance(space, spaces.Box) and space.dtype == np.uint8 and len(space.shape) == 3


def _stack_axis(space: spaces.Box, order: str | None) -> int:
    """Returns the axis of one observation along which it is stacked."""
    if order not in (None, "first", "last"):
        raise ValueError(f"channels_order={order!r} must be 'first', 'last' or None")
    if order is None:
        first = _is_image(space) and int(np.argmin(space.shape)) == 0
        order = "first" if first else "last"
    return 0 if order == "first" else len(space.shape) - 1
