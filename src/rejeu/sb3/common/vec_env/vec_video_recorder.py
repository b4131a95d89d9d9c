"""A wrapper that records videos of a vector environment."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rejeu.core.types import Observation
from rejeu.envs.rendering import check_renders
from rejeu.logs.video import VideoFile
from rejeu.sb3.common.vec_env.base_vec_env import VecEnv, VecEnvStepReturn, VecEnvWrapper, tile_images


class VecVideoRecorder(VecEnvWrapper):
    """Records videos of a vector environment while it is stepped.

    A recording starts at a reset or step for which the trigger returns True. It has the frame of that moment and one for
    each of the next ``video_length`` steps. The file is ``{name_prefix}-step-{start}-to-step-{start + video_length}.mp4``,
    even if ``close`` or another triggered ``reset`` ends the recording early. Several environments are shown in a grid.
    Frames are written as they are rendered.

    Args:
        venv: a vector environment whose environments were made with ``render_mode="rgb_array"``.
        video_folder: folder of the videos; created if missing.
        record_video_trigger: function of the number of steps so far that returns whether to start a recording.
        video_length: number of steps of a recording.
        name_prefix: prefix of the file names.

    Raises:
        MissingExtra: if imageio-ffmpeg is not installed.
        ValueError: if the environments were not made with ``render_mode="rgb_array"``.
    """

    def __init__(
        self,
        venv: VecEnv,
        video_folder: str | Path,
        record_video_trigger: Callable[[int], bool],
        video_length: int = 200,
        name_prefix: str = "rl-video",
    ) -> None:
        super().__init__(venv)
        check_renders(venv)
        self.video_folder = Path(video_folder).absolute()
        self.video_folder.mkdir(parents=True, exist_ok=True)
        self.record_video_trigger = record_video_trigger
        self.video_length = video_length
        self.name_prefix = name_prefix
        self.frames_per_sec = float(venv.metadata.get("render_fps") or 30)
        self.step_id = 0
        """Number of steps so far."""
        self.video_path: Path | None = None
        """Path of the current or last recording."""
        self._video: VideoFile | None = None

    @property
    def recording(self) -> bool:
        """Whether a recording is in progress."""
        return self._video is not None

    def reset(self) -> Observation:
        obs = self.venv.reset()
        if self.record_video_trigger(self.step_id):
            self._start()
        return obs

    def step_wait(self) -> VecEnvStepReturn:
        result = self.venv.step_wait()
        self.step_id += 1
        if self._video is not None:
            self._capture(self._video)
        elif self.record_video_trigger(self.step_id):
            self._start()
        return result

    def close(self) -> None:
        self._end()
        self.venv.close()

    def _start(self) -> None:
        self._end()
        name = f"{self.name_prefix}-step-{self.step_id}-to-step-{self.step_id + self.video_length}.mp4"
        self.video_path = self.video_folder / name
        self._video = VideoFile(self.video_path, self.frames_per_sec)
        self._capture(self._video)

    def _capture(self, video: VideoFile) -> None:
        try:
            video.write(tile_images([image for image in self.venv.get_images() if image is not None]))
        except BaseException:
            video.discard()
            self._video = None
            raise
        if video.n_frames > self.video_length:
            self._end()

    def _end(self) -> None:
        if self._video is not None:
            video, self._video = self._video, None
            video.close()
