"""A wrapper that reports every episode's return, length and time, as Stable-Baselines3's ``Monitor`` does."""

from __future__ import annotations

import csv
import io
import json
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym

from rejeu.io import atomic
from rejeu.io.failed_writes import FailedWrites

SUFFIX = "monitor.csv"


class Monitor(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """Adds ``info["episode"] = {"r": return, "l": length, "t": seconds since construction}`` to an episode's last step.

    rejeu counts episodes itself and needs no Monitor; it is for scripts that read its numbers or its file. The file is
    CSV: one line ``#{"t_start": ..., "env_id": ...}``, then the columns ``r,l,t`` and the keywords. It is opened for
    each row and held by nobody in between. Rows that cannot be written wait, with a warning.

    Args:
        env: what to watch.
        filename: of the CSV file; ``.monitor.csv`` is added unless it ends in ``monitor.csv``, and in a folder the file
            is ``monitor.csv``. None writes none.
        allow_early_resets: whether ``reset`` may be called before the episode has ended.
        reset_keywords: arguments of ``reset`` to write down with the episode; each must then be given.
        info_keywords: entries of the last step's info to write down with the episode.
        override_existing: begin the file anew; False adds to it. (Stable-Baselines3 then never writes the first two
            lines; here they are written where there is no file yet.)

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
        # An environment made again from its spec must not write to this one's file.
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
        self.current_reset_info: dict[str, Any] = {}
        self.path = None if filename is None else monitor_path(filename)
        self._failed_writes = FailedWrites()
        if self.path is not None and (override_existing or not self.path.exists()):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            env_id = str(env.spec.id if env.spec is not None else None)
            with self.path.open("w", newline="\n", encoding="utf-8") as file:
                file.write(f"#{json.dumps({'t_start': self.t_start, 'env_id': env_id})}\n")
                csv.writer(file).writerow(self._columns())

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
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
        self.rewards = []
        self.needs_reset = False
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Steps the environment.

        Raises:
            RuntimeError: if the episode has ended or none has begun.
            ValueError: if one of ``info_keywords`` is missing from the info of an episode's last step.
        """
        if self.needs_reset:
            raise RuntimeError("step after the episode has ended; call reset() first")
        obs, reward, terminated, truncated, info = self.env.step(action)
        self.rewards.append(float(reward))
        self.total_steps += 1
        if terminated or truncated:
            self.needs_reset = True
            info["episode"] = self._end_episode(info)
        return obs, reward, terminated, truncated, info

    def _end_episode(self, info: dict[str, Any]) -> dict[str, Any]:
        total, length, seconds = sum(self.rewards), len(self.rewards), time.time() - self.t_start
        self.episode_returns.append(total)
        self.episode_lengths.append(length)
        self.episode_times.append(seconds)
        for key in self.info_keywords:
            if key not in info:
                raise ValueError(f"info_keywords: the info of an episode's last step has no {key!r}, only {[*info]}")
        row = {"r": round(total, 6), "l": length, "t": round(seconds, 6)}
        row |= {key: info[key] for key in self.info_keywords} | self.current_reset_info
        if self.path is not None:
            line = csv_line(row, self._columns())
            self._failed_writes.put(f"rows of {self.path}", partial(atomic.append, self.path), line)
        return row

    def _columns(self) -> tuple[str, ...]:
        return ("r", "l", "t", *self.reset_keywords, *self.info_keywords)

    def close(self) -> None:
        """Closes the environment, after a last attempt at rows that could not be written."""
        self._failed_writes.retry()
        self._failed_writes.warn()
        super().close()

    def get_total_steps(self) -> int:
        """Returns the steps taken in all."""
        return self.total_steps

    def get_episode_rewards(self) -> list[float]:
        """Returns the return of each ended episode."""
        return self.episode_returns

    def get_episode_lengths(self) -> list[int]:
        """Returns the steps of each ended episode."""
        return self.episode_lengths

    def get_episode_times(self) -> list[float]:
        """Returns when each episode ended, in seconds since construction."""
        return self.episode_times


def csv_line(row: Mapping[str, Any], columns: Sequence[str]) -> bytes:
    """Returns a row as a line of a CSV file."""
    text = io.StringIO()
    csv.DictWriter(text, columns).writerow(row)
    return text.getvalue().encode()


def monitor_path(filename: str | Path) -> Path:
    """Returns the file that ``Monitor(env, filename)`` writes to.

    >>> monitor_path("/logs/run").name
    'run.monitor.csv'
    """
    path = Path(filename).absolute()
    if path.name.endswith(SUFFIX):
        return path
    return path / SUFFIX if path.is_dir() else path.with_name(f"{path.name}.{SUFFIX}")
