"""Recording of games as a Minari dataset and a video."""

from __future__ import annotations

import copy
import json
import re
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from rejeu.checkpoints.run_folder import check_free
from rejeu.core import atomic
from rejeu.core.errors import requires
from rejeu.core.failed_writes import FailedWrites
from rejeu.core.types import Action, Observation, PyTree
from rejeu.core.validation import as_path
from rejeu.demonstrations import dataset
from rejeu.envs.validation import id_of
from rejeu.logs.formatting import counted
from rejeu.logs.video import HOLD_SECONDS, VideoFile, ffmpeg

VIDEO_NAME = "video.mp4"


class Recording:
    """A folder with a Minari dataset and a video of the same episodes. Mutable.

    The folder is a Minari path. Every complete episode is on disk, and :func:`rejeu.demonstrations.read` finds it even if the
    process is killed; Minari itself finds it after :meth:`close`, or :func:`rejeu.demonstrations.dataset.merge`. An
    episode that cannot be written is lost, with a warning. The dataset contains the environment's spec, if an
    environment can be made from it. An aborted episode ends in a truncation; an episode without steps is left out. The video
    has one frame after each reset and one for each step. The last frame of an episode is shown for half a second.

    Args:
        folder: new or empty; created with the first episode.
        env: the environment that is played, from whose id the dataset is named.
        fps: frames per second of the video; None writes none.
        by: who plays, ``"human"`` or ``"expert"``; names the dataset.

    Raises:
        MissingExtra: if Minari or imageio-ffmpeg is not installed.
        FileExistsError: if the folder is not empty.
    """

    def __init__(self, folder: str | Path, env: gym.Env, fps: float | None, by: str = "human") -> None:
        with requires("recording", "minari[hdf5]", "play"):
            import h5py  # noqa: F401 - Minari's files
            import minari
            from minari.serialization import serialize_space
        if fps is not None:
            ffmpeg()
        self.folder = as_path(folder).absolute()
        check_free(Path(folder))
        self.dataset_id = re.sub(r"[^\w/-]", "-", id_of(env)) + f"/{by}-v0"
        self.episodes = 0
        """Number of recorded episodes."""
        self._data = self.folder / self.dataset_id / "data"
        spec = spec_of(env)
        self._metadata = {
            "dataset_id": self.dataset_id,
            "data_format": "hdf5",
            "jpeg_encoding": False,  # lossless images
            "minari_version": minari.__version__,
            "observation_space": serialize_space(env.observation_space),
            "action_space": serialize_space(env.action_space),
            "algorithm_name": by,
            "description": "Played by hand with rejeu play" if by == "human" else "Played by an agent",
            **({} if spec is None else dict.fromkeys(("env_spec", "eval_env_spec"), spec.to_json())),
        }
        self._writes = FailedWrites()
        self._video = None if fps is None else VideoFile(self.folder / VIDEO_NAME, fps)
        self._seed: int | None = None
        self._steps: list[tuple[PyTree, ...]] = []
        """Of the running episode: ``(obs,)``, then ``(obs, action, reward, terminated, truncated)``."""
        self._frame: Any = None

    def __str__(self) -> str:
        if not self.episodes:
            return self._writes.summary() or f"{self.folder}: nothing was played, nothing is recorded"
        return (
            f"{self.folder}: {counted(self.episodes, 'episode')}{f' in {VIDEO_NAME} and' if self._video else ''} "
            f"for MINARI_DATASETS_PATH={self.folder}, minari.load_dataset({self.dataset_id!r})"
        ) + (f"; {lost}" if (lost := self._writes.summary()) else "")

    def begin(self, obs: Observation, seed: int | None, frame: np.ndarray | None = None) -> None:
        """Starts an episode, and ends a running one as truncated."""
        self._end()
        self._seed, self._steps = seed, [(copy.deepcopy(obs),)]
        self._frame = frame

    def step(
        self,
        obs: Observation,
        action: Action,
        reward: float,
        terminated: bool,
        truncated: bool,
        frame: np.ndarray | None = None,
    ) -> None:
        """Adds a step."""
        if frame is not None:
            self._show(*([self._frame] if len(self._steps) == 1 else []), frame)
            self._frame = frame
        self._steps.append((copy.deepcopy(obs), copy.deepcopy(action), reward, terminated, truncated))
        if terminated or truncated:
            self._end()

    def close(self) -> None:
        """Completes dataset and video. Nothing is written if nothing was played."""
        try:
            self._end()
            if self.episodes:
                self._writes.attempt("the dataset", lambda: dataset.merge(self._data))
        except BaseException:
            if self._video is not None:
                self._video.discard()
            raise
        self._show(last=True)

    def _end(self) -> None:
        steps, self._steps = self._steps, []
        if len(steps) < 2:
            return
        *others, terminated, truncated = steps[-1]
        steps[-1] = (*others, terminated, truncated or not terminated)
        content = dataset.episode(self.episodes, steps, self._seed, {} if self.episodes else self._metadata)
        write = partial(self._write, self.episodes, content)
        self.episodes += self._writes.attempt("episodes of the recording", write, is_row=True)
        if self._video is not None:
            self._show(*[self._frame] * round(HOLD_SECONDS * self._video.fps))

    def _write(self, i: int, content: bytes) -> None:
        if not (self._data / dataset.METADATA).exists():
            text = json.dumps({"total_episodes": 0, "total_steps": 0, **self._metadata})
            atomic.write(self._data / dataset.METADATA, text)
        atomic.write(self._data / f"episode_{i}.hdf5", content)

    def _show(self, *frames: np.ndarray, last: bool = False) -> None:
        """Adds frames to the video, and completes it after the last. If it cannot be written, the game goes on."""
        if self._video is None:
            return
        try:
            for frame in frames:
                self._video.write(frame)
            if last and self._video.n_frames:
                self._video.close()
        except OSError as error:
            warnings.warn(f"{error}; the game and its dataset go on without a video", UserWarning, stacklevel=3)
            self._video = None


def spec_of(env: gym.Env) -> EnvSpec | None:
    """Returns the spec of an environment without its render mode, None if no environment can be made from it.

    That is so for environments without an id, for those registered with a class, and with wrappers that do not record their
    arguments.
    """
    if env.spec is None or any(wrapper.kwargs is None for wrapper in env.spec.additional_wrappers):
        return None
    spec = copy.deepcopy(env.spec)
    spec.kwargs.pop("render_mode", None)
    try:
        spec.to_json()
    except (ValueError, TypeError):
        return None
    return spec
