"""A wrapper that records return, length and time of every episode, and the reader of its files."""

from __future__ import annotations

import csv
import io
import json
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np

from rejeu.core import atomic
from rejeu.core.failed_writes import FailedWrites
from rejeu.core.types import Action, Info, JsonObject, Observation
from rejeu.envs.snapshot import check_types
from rejeu.logs.tables import MAX_LINE, lines_of

SUFFIX = "monitor.csv"
STATE = {"needs_reset": bool, "total_steps": int, "rewards": list[float], "episode_returns": list[float]}
STATE |= {"episode_lengths": list[int], "episode_times": list[float]}
"""Attributes that hold the whole state of a Monitor, and their types."""


class Monitor(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """Adds ``info["episode"] = {"r": return, "l": length, "t": seconds since construction}`` to an episode's last step.

    Agents do not need a Monitor; it is for scripts that read its attributes or its file. The file is CSV: one line
    ``#{"t_start": ..., "env_id": ...}``, then the columns ``r,l,t`` and the keywords. It is opened for each row and closed
    again. Rows that cannot be written are lost, with a warning.

    Args:
        env: the environment.
        filename: path of the CSV file. ``.monitor.csv`` is added unless it ends in ``monitor.csv``; for a folder the file
            is ``monitor.csv`` in it. None writes no file.
        allow_early_resets: whether ``reset`` may be called before the episode has ended.
        reset_keywords: arguments of ``reset`` to record with the episode; each call must then pass them.
        info_keywords: keys of the last step's info to record with the episode.
        override_existing: replace an existing file; False appends to it. (Stable-Baselines3 then never writes the first
            two lines; here they are written if there is no file yet.)

    >>> env = Monitor(gym.make("CartPole-v1"))
    >>> _ = env.reset(seed=0)
    >>> while not (step := env.step(0))[2]:
    ...     pass
    >>> step[4]["episode"]["l"] == env.get_total_steps()
    True
    """

    EXT = SUFFIX

    def __init__(
        self,
        env: gym.Env,
        filename: str | Path | None = None,
        allow_early_resets: bool = True,
        reset_keywords: Sequence[str] = (),
        info_keywords: Sequence[str] = (),
        override_existing: bool = True,
    ) -> None:
        # A copy made from the spec must not write to the same file.
        gym.utils.RecordConstructorArgs.__init__(self, filename=None, allow_early_resets=allow_early_resets)
        gym.Wrapper.__init__(self, env)
        self.t_start = time.time()
        self.reset_keywords, self.info_keywords = tuple(reset_keywords), tuple(info_keywords)
        self.allow_early_resets = allow_early_resets
        self.rewards: list[float] = []
        self.needs_reset = True
        self.episode_returns: list[float] = []
        self.episode_lengths: list[int] = []
        self.episode_times: list[float] = []
        self.total_steps = 0
        self.current_reset_info: Info = {}
        keywords = (*self.reset_keywords, *self.info_keywords)
        start = {"t_start": self.t_start, "env_id": str(env.spec.id if env.spec is not None else None)}
        self._file = None if filename is None else ResultsWriter(filename, start, keywords, override_existing)
        self.path = None if self._file is None else self._file.path

    def reset(self, **kwargs: Any) -> tuple[Observation, Info]:
        """Resets the environment with the arguments given.

        Raises:
            RuntimeError: if the episode has not ended and early resets are not allowed.
            ValueError: if one of ``reset_keywords`` is missing.
        """
        if not self.allow_early_resets and not self.needs_reset:
            raise RuntimeError(
                "reset before the episode has ended; to allow it use Monitor(env, allow_early_resets=True)"
            )
        for key in self.reset_keywords:
            if kwargs.get(key) is None:
                raise ValueError(f"reset needs the argument {key!r}, one of reset_keywords={self.reset_keywords}")
            self.current_reset_info[key] = kwargs[key]
        self.rewards, self.needs_reset = [], True  # also after an exception
        result = self.env.reset(**kwargs)
        self.needs_reset = False
        return result

    def step(self, action: Action) -> tuple[Observation, SupportsFloat, bool, bool, Info]:
        """Steps the environment.

        Raises:
            RuntimeError: if the episode has ended, or before the first reset.
            ValueError: if one of ``info_keywords`` is missing from the info of an episode's last step.
        """
        if self.needs_reset:
            raise RuntimeError("step after the episode has ended; call reset() first")
        self.needs_reset = True  # also after an exception
        obs, reward, terminated, truncated, info = self.env.step(action)
        self.needs_reset = bool(terminated or truncated)
        self.rewards.append(float(reward))
        self.total_steps += 1
        if self.needs_reset:
            info["episode"] = self._end_episode(info)
        return obs, reward, terminated, truncated, info

    def _end_episode(self, info: Info) -> Info:
        total, length, seconds = sum(self.rewards), len(self.rewards), time.time() - self.t_start
        self.episode_returns.append(total)
        self.episode_lengths.append(length)
        self.episode_times.append(seconds)
        row = {"r": round(total, 6), "l": length, "t": round(seconds, 6)}
        row |= keywords_of(info, self.info_keywords) | self.current_reset_info
        if self._file is not None:
            self._file.write_row(row)
        return row

    def get_wrapper_state(self) -> JsonObject:
        """Returns the state of the wrapper, for the checkpoint of a run."""
        return {name: vars(self)[name] for name in STATE}

    def set_wrapper_state(self, state: Mapping[str, object]) -> None:
        """Restores what :meth:`get_wrapper_state` returned.

        Raises:
            ValueError: if it is damaged.
        """
        check_types(self, state, STATE)
        vars(self).update(state)

    def get_total_steps(self) -> int:
        """Returns the total number of steps."""
        return self.total_steps

    def get_episode_rewards(self) -> list[float]:
        """Returns the return of each finished episode."""
        return self.episode_returns

    def get_episode_lengths(self) -> list[int]:
        """Returns the length of each finished episode."""
        return self.episode_lengths

    def get_episode_times(self) -> list[float]:
        """Returns the end of each finished episode, in seconds since construction."""
        return self.episode_times


class ResultsWriter:
    """The CSV file of a monitor. Rows that cannot be written are lost, with a warning.

    Args:
        filename: as for :class:`Monitor`.
        header: the first line, as JSON.
        extra_keys: names of the columns after ``r``, ``l`` and ``t``.
        override_existing: replace an existing file; False appends to it.
    """

    def __init__(
        self,
        filename: str | Path = "",
        header: Mapping[str, object] | None = None,
        extra_keys: Sequence[str] = (),
        override_existing: bool = True,
    ) -> None:
        self.path, self.columns = monitor_path(filename), ("r", "l", "t", *extra_keys)
        self._failed_writes = FailedWrites()
        if override_existing or not self.path.exists():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with atomic.open_file(self.path, "w", newline="\n", encoding="utf-8") as file:
                file.write(f"#{json.dumps(header or {})}\n")
                csv.writer(file).writerow(self.columns)

    def write_row(self, epinfo: Info) -> None:
        """Writes the row of an episode."""
        text = io.StringIO()
        csv.DictWriter(text, self.columns).writerow(epinfo)
        line = text.getvalue().encode()
        self._failed_writes.attempt(f"rows of {self.path}", partial(atomic.append, self.path, line), is_row=True)

    def close(self) -> None:
        """Does nothing, because rows are not buffered."""


def keywords_of(info: Info, keywords: Sequence[str]) -> Info:
    """Returns the entries of an episode's last info that are recorded.

    Raises:
        ValueError: if one is missing.
    """
    for key in keywords:
        if key not in info:
            raise ValueError(f"info_keywords: the info of an episode's last step has no {key!r}, only {[*info]}")
    return {key: info[key] for key in keywords}


def monitor_path(filename: str | Path) -> Path:
    """Returns the file that ``Monitor(env, filename)`` writes to.

    >>> monitor_path("/logs/run").name
    'run.monitor.csv'
    """
    path = Path(filename).absolute()
    if path.name.endswith(SUFFIX):
        return path
    return path / SUFFIX if path.is_dir() else path.with_name(f"{path.name}.{SUFFIX}")


class LoadMonitorResultsError(Exception):
    """Raised if there are no monitor files, or one cannot be read."""


def get_monitor_files(path: str | Path) -> list[str]:
    """Returns the monitor files of a folder, sorted."""
    return sorted(str(file) for file in Path(path).glob(f"*{SUFFIX}"))


def load_results(path: str | Path) -> np.recarray:
    """Returns the episodes of all monitor files of a folder, in the order in which they ended.

    A NumPy record array: ``table["r"]`` or ``table.r`` are returns, ``l`` lengths, ``t`` seconds since the first file was
    created, followed by the other columns of the files. ``pandas.DataFrame(table)`` converts it to a data frame.

    Raises:
        LoadMonitorResultsError: if there are none, or their columns differ.
    """
    files = get_monitor_files(path)
    if not files:
        raise LoadMonitorResultsError(f"there are no files *{SUFFIX} in {path}; Monitor(env, folder) writes them")
    starts, rows, columns = [], [], None
    for name in files:
        with open(name, newline="", encoding="utf-8") as file:
            try:
                start = float(json.loads(file.readline(MAX_LINE).removeprefix("#"))["t_start"])
                reader = csv.DictReader(lines_of(file))
                episodes = [{**row, "t": float(row["t"]) + start} for row in reader]
            except (ValueError, KeyError, TypeError, csv.Error) as error:
                raise LoadMonitorResultsError(f"{name} was not written by Monitor: {error}") from None
        if columns not in (None, reader.fieldnames):
            raise LoadMonitorResultsError(f"{name} has the columns {reader.fieldnames}, other files have {columns}")
        columns = reader.fieldnames
        starts.append(start)
        rows += episodes
    assert columns is not None
    rows.sort(key=lambda row: row["t"])
    arrays = {key: _column([row[key] for row in rows]) for key in columns}
    arrays["t"] = np.array([row["t"] for row in rows], np.float64) - min(starts)
    return np.rec.fromarrays([*arrays.values()], names=list(arrays))  # type: ignore[call-overload]


def _column(values: Sequence[object]) -> np.ndarray:
    """Returns values as integers if possible, else as floats, else as strings."""
    for dtype in (np.int64, np.float64):
        try:
            return np.array(values, dtype=dtype)
        except ValueError:
            continue
    return np.array(values, dtype=str)
