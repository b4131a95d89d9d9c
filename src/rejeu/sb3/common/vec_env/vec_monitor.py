"""A wrapper that records return and length of every episode of a vector environment."""

from __future__ import annotations

import csv
import json
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rejeu.io import atomic
from rejeu.io.failed_writes import FailedWrites
from rejeu.sb3.common.monitor import Monitor, csv_line, monitor_path
from rejeu.sb3.common.vec_env.base_vec_env import StepResult, VecEnv, VecEnvWrapper

__all__ = ["VecMonitor"]


class VecMonitor(VecEnvWrapper):
    """Adds ``info["episode"] = {"r": return, "l": length, "t": seconds since construction}`` to an episode's last step.

    Args:
        venv: the vector environment.
        filename: path of a CSV file, in the format of :class:`rejeu.Monitor`; None writes no file.
        info_keywords: keys of the last step's info to record with the episode.
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
        """Writes rows that could not be written before, if possible, and closes the environments."""
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
