"""Recording of games as a Minari dataset and a video."""

from __future__ import annotations

import copy
import re
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from rejeu.envs.rendering import environment_variable
from rejeu.envs.validation import id_of
from rejeu.errors import MissingExtra
from rejeu.reporting.formatting import counted
from rejeu.reporting.video import HOLD_SECONDS, VideoFile, ffmpeg

VIDEO_NAME = "video.mp4"


class Recording:
    """A folder with a Minari dataset and a video of the same episodes. Mutable.

    The folder is a Minari path. The dataset is complete after every episode. It contains the environment's spec, if an
    environment can be made from it. An aborted episode ends in a truncation; an episode without steps is left out. The
    video has one frame after each reset and one for each step. The last frame of an episode is shown for half a second.

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
        try:
            import h5py  # noqa: F401 - Minari's files
            import minari
            from minari.data_collector.episode_buffer import EpisodeBuffer
        except ImportError:
            raise MissingExtra("recording", "minari[hdf5]", "play") from None
        if fps is not None:
            ffmpeg()
        self._minari, self._buffer_type = minari, EpisodeBuffer
        self.folder = Path(folder).absolute()
        if self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir())):
            raise FileExistsError(f"{folder} exists and is not an empty folder; choose another one")
        self.dataset_id = re.sub(r"[^\w/-]", "-", id_of(env)) + f"/{by}-v0"
        self.episodes = 0
        """Number of recorded episodes."""
        self._description = gym.Env[Any, Any]()
        """The spec and the spaces, which are all that Minari reads of an environment."""
        self._description.spec = spec_of(env)
        self._description.observation_space, self._description.action_space = env.observation_space, env.action_space
        self._dataset: Any = None
        self._video = None if fps is None else VideoFile(self.folder / VIDEO_NAME, fps)
        self._by = by
        self._buffer: Any = None
        self._frame: Any = None

    def __str__(self) -> str:
        if not self.episodes:
            return f"{self.folder}: nothing was played, nothing is recorded"
        return (
            f"{self.folder}: {counted(self.episodes, 'episode')} in {VIDEO_NAME} and for MINARI_DATASETS_PATH={self.folder}, "
            f"minari.load_dataset({self.dataset_id!r})"
        )

    def begin(self, obs: Any, seed: int | None, frame: np.ndarray | None = None) -> None:
        """Starts an episode, and ends a running one as truncated."""
        self._end()
        self._buffer = self._buffer_type(seed=seed, observations=copy.deepcopy(obs))
        self._frame = frame

    def step(
        self,
        obs: Any,
        action: Any,
        reward: float,
        terminated: bool,
        truncated: bool,
        frame: np.ndarray | None = None,
    ) -> None:
        """Adds a step."""
        if self._video is not None and frame is not None:
            if not len(self._buffer):
                self._video.write(self._frame)
            self._video.write(frame)
            self._frame = frame
        self._buffer = self._buffer.add_step_data(
            {
                "observation": copy.deepcopy(obs),
                "action": copy.deepcopy(action),
                "reward": reward,
                "terminated": terminated,
                "truncated": truncated,
                "info": {},
            }
        )
        if terminated or truncated:
            self._end()

    def close(self) -> None:
        """Completes dataset and video. Nothing is written if nothing was played."""
        try:
            self._end()
        except BaseException:
            if self._video is not None:
                self._video.discard()
            raise
        if self._video is not None and self._video.n_frames:
            self._video.close()

    def _end(self) -> None:
        buffer, self._buffer = self._buffer, None
        if buffer is None or not len(buffer):
            return
        if not buffer.terminations[-1]:
            buffer.truncations[-1] = True
        if self._dataset is None:
            self._dataset = self._create(buffer)
        else:
            self._dataset.update_dataset_from_buffer([buffer])
        self.episodes += 1
        if self._video is not None:
            for _ in range(round(HOLD_SECONDS * self._video.fps)):
                self._video.write(self._frame)

    def _create(self, buffer: Any) -> Any:
        described = None if self._description.spec is None else self._description
        with environment_variable("MINARI_DATASETS_PATH", str(self.folder)), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # for example about the missing author
            return self._minari.create_dataset_from_buffers(
                self.dataset_id,
                [buffer],
                env=described,
                eval_env=described,
                observation_space=self._description.observation_space,
                action_space=self._description.action_space,
                algorithm_name=self._by,
                description="Played by hand with rejeu play" if self._by == "human" else "Played by an agent",
                data_format="hdf5",
                jpeg_encoding=False,  # lossless images
            )


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
