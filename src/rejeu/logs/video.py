"""Videos of a policy: mp4, webm or gif, written frame by frame by ffmpeg without a display, and shown in a notebook."""

from __future__ import annotations

import base64
import dataclasses
import html
import os
import re
import secrets
import subprocess
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import gymnasium as gym
import numpy as np

from rejeu.core import atomic
from rejeu.core.errors import requires
from rejeu.core.interrupt import Interrupt
from rejeu.core.validation import as_path, number, whole
from rejeu.envs.make import InProcess
from rejeu.envs.masks import for_agent
from rejeu.envs.registry import make_env, provider, register
from rejeu.envs.rendering import check_renders, make_rendering_env, natural_fps, rgb_frame

HOLD_SECONDS = 0.5
"""How long the last frame of an episode is shown."""
EVEN = "pad=ceil(iw/2)*2:ceil(ih/2)*2"
"""Filter that gives the frames even heights and widths, which most formats need."""
FORMATS = {
    ".mp4": ("-vf", EVEN, "-c:v", "libx264", "-preset", "veryfast", "-pix_fmt", "yuv420p", "-movflags", "+faststart"),
    ".webm": ("-vf", EVEN, "-c:v", "libvpx-vp9", "-pix_fmt", "yuv420p", "-crf", "32", "-b:v", "0"),
    ".gif": (
        "-vf",
        "split[frames][same];[same]palettegen=stats_mode=diff[palette];[frames][palette]paletteuse=dither=none",
    ),
}
"""Options of ffmpeg by suffix."""


def ffmpeg() -> str:
    """Returns the path of the ffmpeg program.

    Raises:
        MissingExtra: if imageio-ffmpeg, which contains it, is not installed.
    """
    with requires("recording a video", "imageio-ffmpeg", "video"):
        import imageio_ffmpeg
    return imageio_ffmpeg.get_ffmpeg_exe()


class VideoFile:
    """A video that appears at its path when it is closed: an mp4 file with H.264, a webm file with VP9, or a gif.

    Odd heights and widths are padded by a black line, except in a gif. As a context manager it is closed at the end, or
    discarded after an exception. ``imageio_ffmpeg.write_frames`` is not used: it ignores ffmpeg's exit status, so that a full
    disk leaves half a video without an error, and it forks while JAX's threads run, about which JAX warns.

    Args:
        path: path of the file. ``.mp4`` is added to a path without a suffix.
        fps: frames per second.
    """

    def __init__(self, path: str | Path, fps: float) -> None:
        path = as_path(path)
        if path.suffix not in ("", *FORMATS):
            raise ValueError(f"path={str(path)!r} must end in one of {', '.join(FORMATS)}")
        self.path = (path if path.suffix else path.with_name(path.name + ".mp4")).absolute()
        self.fps = fps
        self.n_frames = 0
        self._partial = self.path.with_name(f".{self.path.stem}.{secrets.token_hex(4)}.partial{self.path.suffix}")
        self._program = ffmpeg()
        self._process: subprocess.Popen[bytes] | None = None
        self._shape: tuple[int, ...] = ()

    def write(self, frame: np.ndarray) -> None:
        """Adds a frame, ``uint8 (height, width, 3)``. All frames must have the same shape.

        Raises:
            OSError: if it cannot be written.
            ValueError: for a frame of another shape or type.
        """
        if self._process is None:
            self._process = self._start(frame.shape)
        if frame.shape != self._shape or frame.dtype != np.uint8:
            raise ValueError(
                f"frame {self.n_frames} is {frame.dtype} of shape {frame.shape}, expected uint8 of shape {self._shape}"
            )
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(np.ascontiguousarray(frame).data)
        except OSError:
            self._finish(self._process)
        self.n_frames += 1

    def close(self) -> Path:
        """Completes the file, moves it to its path and returns the path.

        Raises:
            OSError: if it could not be written; an existing file is not changed.
            ValueError: if no frame was written.
        """
        if self._process is None:
            raise ValueError(f"{self.path} has no frames")
        self._finish(self._process)
        atomic.replace_patiently(self._partial, self.path)
        return self.path

    def discard(self) -> None:
        """Discards the file."""
        if self._process is not None:
            self._process.kill()
            with suppress(OSError):
                self._process.communicate()
            self._partial.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error_type is None:
            self.close()
        else:
            self.discard()

    def _start(self, shape: tuple[int, ...]) -> subprocess.Popen[bytes]:
        self._shape = shape
        self.path.parent.mkdir(parents=True, exist_ok=True)
        height, width = shape[:2]
        return subprocess.Popen(
            [
                *(self._program, "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"),
                *("-s", f"{width}x{height}", "-r", str(self.fps), "-i", "-", "-an"),
                *(*FORMATS[self.path.suffix], str(self._partial)),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            # Ctrl-C must not reach ffmpeg, so that the file can still be closed
            process_group=0 if os.name == "posix" else None,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
        )

    def _finish(self, process: subprocess.Popen[bytes]) -> None:
        """Waits until ffmpeg has written everything; raises its last message if it failed."""
        _, errors = process.communicate()
        if process.returncode != 0:
            self._partial.unlink(missing_ok=True)
            lines = errors.decode(errors="replace").strip().splitlines()
            raise OSError(f"{self.path} could not be written; ffmpeg: {lines[-1] if lines else 'no message'}")


PLAYBACK_FPS = {"parking-v0": 15.0, "jax/Parking-v0": 15.0}
"""Frames per second of environments whose ``render_fps`` is too slow for a video."""
RECORDER = "gymnasium.wrappers.rendering:RecordVideo"
"""Entry point of the wrapper that records training episodes."""


def record_video(
    agent: Any,
    path: str | Path,
    env: Any = None,
    episodes: int = 3,
    max_steps: int = 1500,
    seed: int | None = None,
    fps: float | None = None,
) -> Path:
    """Records the agent's deterministic policy to an mp4, webm or gif file, and returns the path of the file.

    The video has one frame after each reset and one for each step. The last frame of an episode is shown for half a second.
    An existing file is replaced when the new one is complete.

    Args:
        agent: anything with ``predict(obs, state, deterministic=True) -> (action, state)``.
        path: path of the file. ``.mp4`` is added to a path without a suffix, missing folders are created.
        env: an id, an environment made with ``render_mode="rgb_array"`` (which is not closed), a function that makes one,
            or None for a new environment like the agent's own.
        episodes: number of episodes.
        max_steps: maximum number of environment steps, over all episodes.
        seed: seed of the first reset; None draws a seed.
        fps: frames per second of the file; None for the environment's ``render_fps``, 15 for parking-v0 (three times real
            time), 30 if it declares none.

    Raises:
        MissingExtra: if imageio-ffmpeg is not installed.
        ValueError: if the environment does not render to arrays.
        TypeError: if ``env`` has another type.
        KeyboardInterrupt: after Ctrl-C or SIGTERM; the new file is removed.

    >>> import rejeu, tempfile
    >>> from rejeu.logs.video import record_video
    >>> agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", seed=0)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     record_video(agent, folder + "/pendulum", episodes=1, max_steps=10).name
    'pendulum.mp4'
    """
    episodes, steps_left = whole("episodes", episodes, least=1), whole("max_steps", max_steps, least=1)
    fps = None if fps is None else number("fps", fps, above=0)
    ffmpeg()
    is_open = isinstance(env, gym.Env)
    playing_env = for_agent(agent, env if is_open else rendering_env(agent, env))
    try:
        check_renders(playing_env)
        with Interrupt() as stop, VideoFile(path, playback_fps(playing_env) if fps is None else fps) as video:
            for _ in range(episodes):
                obs, _ = playing_env.reset(seed=seed)
                seed, done, state = None, False, None
                video.write(rgb_frame(playing_env))
                while not done and steps_left:
                    stop.check()
                    action, state = agent.predict(obs, state, deterministic=True)
                    obs, _, terminated, truncated, _ = playing_env.step(action)
                    frame = rgb_frame(playing_env)
                    video.write(frame)
                    steps_left -= 1
                    done = terminated or truncated
                if not steps_left:
                    break
                for _ in range(round(HOLD_SECONDS * video.fps)):
                    video.write(frame)
    finally:
        if not is_open:
            playing_env.close()
    return video.path


def rendering_env(agent: Any, env: Any) -> gym.Env:
    """Makes an environment that renders to arrays: from an id, from a function, or like the agent's own if None."""
    if isinstance(env, str):
        return make_rendering_env(partial(make_env, env), env)
    if env is not None:
        rendering = env() if callable(env) else env
        if not isinstance(rendering, gym.Env):
            raise TypeError(
                "env must be an id, a Gymnasium environment, a function that makes one or None, got "
                f"{type(rendering).__name__}"
            )
        return rendering
    vector, origin = agent.run.env, getattr(agent, "origin", None)
    if vector is None and origin is None:
        raise ValueError("this agent has no environment; pass one: record_video(agent, path, env='parking-v0')")
    if vector is not None and vector.wrapped_by is not None:
        raise ValueError(
            f"the agent's own environments are wrapped in {vector.wrapped_by}, which a new one would not have; "
            "use a VecVideoRecorder, or pass env="
        )
    spec = vector.envs[0].spec if isinstance(vector, InProcess) else None
    env_id, env_kwargs = origin or (vector.env_id, {})
    if spec is None and provider(env_id) is None and not register(env_id):
        raise ValueError(
            f"the agent's own environment {env_id} is not registered, so it cannot be made again; pass "
            "env=, made with render_mode='rgb_array'"
        )
    try:
        if spec is None:
            return make_rendering_env(partial(make_env, env_id, **env_kwargs), env_id)
        make = partial(gym.make, without_recorder(spec), disable_env_checker=True)
        return make_rendering_env(make, spec.id, {"render_mode": None} if "render_mode" in spec.kwargs else {})
    except ValueError as error:
        if "RecordConstructorArgs" not in str(error):
            raise
        raise ValueError(
            f"the wrappers of the agent's own environment {env_id} cannot be made again ({error}); pass "
            "env=, made with render_mode='rgb_array' and the same wrappers"
        ) from None


def without_recorder(spec: gym.envs.registration.EnvSpec) -> gym.envs.registration.EnvSpec:
    """Returns a spec without ``RecordVideo``, which would overwrite the videos of the first environment."""
    wrappers = tuple(wrapper for wrapper in spec.additional_wrappers if wrapper.entry_point != RECORDER)
    return dataclasses.replace(spec, additional_wrappers=wrappers)


def playback_fps(env: gym.Env) -> float:
    """Returns the frames per second of a video of an environment."""
    return PLAYBACK_FPS.get(env.spec.id if env.spec is not None else "", natural_fps(env))


@dataclass(frozen=True)
class Html:
    """HTML text that a notebook shows."""

    data: str

    def _repr_html_(self) -> str:
        return self.data


def show_videos(folder: str | Path = "videos", prefix: str = "") -> Html:
    """Returns the mp4 files of a folder as HTML that a notebook shows.

    They are sorted by the numbers in their names. The videos are embedded, so they remain in the notebook when the files are
    deleted. Outside a notebook the HTML is in ``.data``.

    Args:
        folder: folder with the videos, without its subfolders.
        prefix: only files whose name starts with it.

    >>> show_videos("no-such-folder").data
    '<p>No mp4 file in no-such-folder.</p>'
    """
    files = [path for path in as_path(folder).glob("*.mp4") if path.name.startswith(prefix) and path.name[0] != "."]
    files.sort(key=lambda path: by_number(path.name))
    text = "\n".join(_player(path) for path in files)
    if not files:
        description = f" whose name starts with {prefix}" if prefix else ""
        text = f"<p>No mp4 file{html.escape(description)} in {html.escape(str(folder))}.</p>"
    return Html(text)


def by_number(name: str) -> list[tuple[int, int, str]]:
    """Returns a sort key that orders the numbers in names by their values.

    >>> sorted(["episode-10.mp4", "episode-9.mp4", "a.mp4"], key=by_number)
    ['a.mp4', 'episode-9.mp4', 'episode-10.mp4']
    """
    return [(1, int(piece), "") if piece.isdecimal() else (0, 0, piece) for piece in re.split(r"(\d+)", name)]


def _player(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    return (
        f"<figure><video title='{html.escape(path.name)}' autoplay loop muted controls style='height: 400px;'>"
        f"<source src='data:video/mp4;base64,{data}' type='video/mp4'></video>"
        f"<figcaption>{html.escape(path.name)}</figcaption></figure>"
    )
