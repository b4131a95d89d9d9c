"""A wrapper that records return and length of every episode of a vector environment."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rejeu.core.types import Info, JsonObject, Observation
from rejeu.sb3.common.monitor import Monitor, ResultsWriter, keywords_of
from rejeu.sb3.common.vec_env.base_vec_env import VecEnv, VecEnvStepReturn, VecEnvWrapper


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
        start = {"t_start": self.t_start, "env_id": None}
        self._file = None if filename is None else ResultsWriter(filename, start, self.info_keywords)
        self.path = None if self._file is None else self._file.path

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
        super().close()

    def reset(self) -> Observation:
        self.episode_returns = np.zeros(self.num_envs)
        self.episode_lengths = np.zeros(self.num_envs, np.int64)
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        self.episode_returns += rewards
        self.episode_lengths += 1
        infos = list(infos)
        for i in np.flatnonzero(dones).tolist():
            infos[i] = {**infos[i], "episode": self._end_episode(i, infos[i])}
        return obs, rewards, dones, infos

    def _end_episode(self, i: int, info: Info) -> Info:
        seconds = round(time.time() - self.t_start, 6)
        row: JsonObject = {"r": float(self.episode_returns[i]), "l": int(self.episode_lengths[i]), "t": seconds}
        row |= keywords_of(info, self.info_keywords)
        self.episode_count += 1
        self.episode_returns[i] = self.episode_lengths[i] = 0
        if self._file is not None:
            self._file.write_row(row)
        return row
