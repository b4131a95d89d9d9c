"""Videos of a policy: H.264 in mp4 files, recorded without a display, shown in a notebook."""

from __future__ import annotations

import base64
import ctypes.util
import dataclasses
import html
import os
import re
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, Self

import gymnasium as gym
import numpy as np

from rejeu.envs.make import InProcess
from rejeu.envs.masks import for_agent
from rejeu.envs.registry import make_env, provider, register
from rejeu.errors import MissingExtra
from rejeu.interrupt import Interrupt
from rejeu.validation import number, whole

DEFAULT_FPS = 30.0
"""Frames per second of environments that declare none."""
PLAYBACK_FPS = {"parking-v0": 15.0, "jax/Parking-v0": 15.0}
"""Frames per second of environments whose ``render_fps`` is too slow for a video."""
RECORDER = "gymnasium.wrappers.rendering:RecordVideo"
"""Entry point of the wrapper that records training episodes."""
HOLD_SECONDS = 0.5
"""How long the last frame of an episode is shown."""


def record_video(
    agent: Any,
    path: str | Path,
    env: Any = None,
    episodes: int = 3,
    max_steps: int = 1500,
    seed: int | None = None,
    fps: float | None = None,
) -> Path:
    """Records the agent's deterministic policy to an mp4 file, and returns the path of the file.

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
    >>> from rejeu.reporting.video import record_video
    >>> agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", seed=0)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     record_video(agent, folder + "/pendulum", episodes=1, max_steps=10).name
    'pendulum.mp4'
    """
    episodes, steps_left = whole("episodes", episodes, least=1), whole("max_steps", max_steps, least=1)
    fps = None if fps is None else number("fps", fps, above=0)
    ffmpeg()
    given = isinstance(env, gym.Env)
    playing_env = for_agent(agent, env if given else rendering_env(agent, env))
    try:
        check_renders(playing_env)
        with Interrupt() as stop, VideoFile(path, natural_fps(playing_env) if fps is None else fps) as video:
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
        if not given:
            playing_env.close()
    return video.path


def rendering_env(agent: Any, env: Any) -> gym.Env:
    """Makes an environment that renders to arrays: from an id, from a function, or like the agent's own if None."""
    if isinstance(env, str):
        return _make_from_spec(env)
    if env is not None:
        made = env() if callable(env) else env
        if not isinstance(made, gym.Env):
            raise TypeError(
                "env must be an id, a Gymnasium environment, a function that makes one or None, got "
                f"{type(made).__name__}"
            )
        return made
    vector = agent.env
    if vector is None:
        raise ValueError("this agent has no environment; pass one: record_video(agent, path, env='parking-v0')")
    if vector.wrapped_by is not None:
        raise ValueError(
            f"the agent's own environments are wrapped in {vector.wrapped_by}, which a new one would not have; "
            "use a VecVideoRecorder, or pass env="
        )
    spec = vector.envs[0].spec if isinstance(vector, InProcess) else None
    if spec is None and provider(vector.env_id) is None and not register(vector.env_id):
        raise ValueError(
            f"the agent's own environment {vector.env_id} is not registered, so it cannot be made again; pass "
            "env=, made with render_mode='rgb_array'"
        )
    try:
        return _make_from_spec(vector.env_id if spec is None else _without_recorder(spec))
    except ValueError as error:
        if "RecordConstructorArgs" not in str(error):
            raise
        raise ValueError(
            f"the wrappers of the agent's own environment {vector.env_id} cannot be made again ({error}); pass "
            "env=, made with render_mode='rgb_array' and the same wrappers"
        ) from None


def _without_recorder(spec: gym.envs.registration.EnvSpec) -> gym.envs.registration.EnvSpec:
    """Returns a spec without ``RecordVideo``, which would overwrite the videos of the first environment."""
    wrappers = tuple(one for one in spec.additional_wrappers if one.entry_point != RECORDER)
    return dataclasses.replace(spec, additional_wrappers=wrappers)


def _make_from_spec(source: str | gym.envs.registration.EnvSpec) -> gym.Env:
    """Makes an environment from an id or a spec; see :func:`make_rendering_env`."""

    def make(**kwargs: Any) -> gym.Env:
        if isinstance(source, str):
            return make_env(source, **kwargs)
        return gym.make(source, disable_env_checker=True, **kwargs)

    pinned = not isinstance(source, str) and "render_mode" in source.kwargs
    return make_rendering_env(
        make, source if isinstance(source, str) else source.id, {"render_mode": None} if pinned else {}
    )


def make_rendering_env(
    make: Callable[..., gym.Env], env_id: str, plain_kwargs: Mapping[str, Any] = MappingProxyType({})
) -> gym.Env:
    """Returns ``make(render_mode="rgb_array")``, an environment that renders to arrays.

    Args:
        make: makes environments.
        env_id: id for messages.
        plain_kwargs: keyword arguments with which ``make`` makes an environment that does not render.

    Raises:
        ValueError: if the environment lacks this render mode, about which ``gymnasium.make`` only warns.
    """
    plain = make(**plain_kwargs)
    modes = plain.metadata.get("render_modes") or []
    plain.close()
    if "rgb_array" not in modes:
        raise ValueError(
            f"{env_id} cannot be rendered to arrays: its render modes are {list(modes)}, expected 'rgb_array' among them; "
            "pass another environment as env="
        )
    return make(render_mode="rgb_array")


def check_renders(env: Any) -> None:
    """Raises ValueError unless ``env``, an environment or a vector of them, was made to render to arrays."""
    if env.render_mode != "rgb_array":
        raise ValueError(
            f"an environment made with render_mode={env.render_mode!r} cannot be recorded; make it with "
            "gymnasium.make(id, render_mode='rgb_array')"
        )


def natural_fps(env: gym.Env) -> float:
    """Returns the frames per second of a video of an environment."""
    if env.spec is not None and env.spec.id in PLAYBACK_FPS:
        return PLAYBACK_FPS[env.spec.id]
    return float(env.metadata.get("render_fps") or DEFAULT_FPS)


def rgb_frame(env: gym.Env) -> np.ndarray:
    """Returns a rendered frame, ``uint8 (height, width, 3)``; needs no display.

    Raises:
        ValueError: if it renders anything else, or if MuJoCo has no OpenGL context.
    """
    with display_for_pygame(), explain_mujoco_errors(env):
        frame = env.render()
    if not isinstance(frame, np.ndarray) or frame.ndim != 3 or frame.shape[2] != 3:
        got = f"an array of shape {frame.shape}" if isinstance(frame, np.ndarray) else type(frame).__name__
        raise ValueError(
            f"{env} cannot be recorded: render() returned {got}, expected an array (height, width, 3); make it with "
            "render_mode='rgb_array'"
        )
    return frame


@contextmanager
def display_for_pygame() -> Iterator[None]:
    """Lets pygame render without a display, by SDL's ``dummy`` driver; restores the environment variable at the end.

    While ``SDL_VIDEODRIVER=dummy`` is set, highway-env renders black frames. Therefore the variable is set only while pygame's
    display is opened.
    """
    before = os.environ.get("SDL_VIDEODRIVER")
    driver = "dummy" if before is None and is_headless() else before
    try:
        if driver == "dummy":
            os.environ["SDL_VIDEODRIVER"] = driver
            if "pygame" in sys.modules:
                display = sys.modules["pygame"].display
                if not display.get_init():
                    display.init()
                del os.environ["SDL_VIDEODRIVER"]
        yield
    finally:
        if before is None:
            os.environ.pop("SDL_VIDEODRIVER", None)
        else:
            os.environ["SDL_VIDEODRIVER"] = before


@contextmanager
def headless_mujoco() -> Iterator[None]:
    """Lets MuJoCo render without a display, by EGL or OSMesa, unless ``MUJOCO_GL`` is set; restores it at the end."""
    if "mujoco" not in sys.modules or "MUJOCO_GL" in os.environ or not is_headless():
        yield
        return
    libraries = {"egl": "EGL", "osmesa": "OSMesa"}
    driver = next((name for name, library in libraries.items() if ctypes.util.find_library(library)), None)
    try:
        if driver is not None:
            os.environ["MUJOCO_GL"] = driver
        yield
    finally:
        os.environ.pop("MUJOCO_GL", None)


def is_headless() -> bool:
    """Returns whether this is Linux without a display."""
    return sys.platform.startswith("linux") and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys()


@contextmanager
def explain_mujoco_errors(env: gym.Env) -> Iterator[None]:
    """Raises ``ValueError`` with the fix if MuJoCo cannot render without a display."""
    try:
        with headless_mujoco(), warnings.catch_warnings():
            warnings.filterwarnings("ignore", r"\(\d+\) b'")  # GLFW's, which the error below explains
            yield
    except Exception as error:
        kind = type(error)
        if (kind.__module__, kind.__name__) != ("mujoco", "FatalError"):
            raise
        chosen = os.environ.get("MUJOCO_GL")
        fix = "set the environment variable MUJOCO_GL=egl (or osmesa) before starting Python"
        if chosen is None:
            fix = f"install EGL (on Debian and Ubuntu libegl1) or OSMesa (libosmesa6), or {fix}"
        raise ValueError(
            f"{env} cannot be rendered: MuJoCo has no OpenGL context with MUJOCO_GL={chosen or '(unset)'}, expected a display "
            f"or an offscreen renderer; {fix}"
        ) from error


def ffmpeg() -> str:
    """Returns the path of the ffmpeg program.

    Raises:
        MissingExtra: if imageio-ffmpeg, which contains it, is not installed.
    """
    try:
        import imageio_ffmpeg
    except ImportError:
        raise MissingExtra("recording a video", "imageio-ffmpeg", "video") from None
    return imageio_ffmpeg.get_ffmpeg_exe()


class VideoFile:
    """An mp4 file that is written frame by frame and appears at its path when it is closed.

    H.264, yuv420p; odd heights and widths are padded by a black line. As a context manager it is closed at the end, or
    discarded after an exception. ffmpeg is started directly: ``imageio_ffmpeg.write_frames`` uses ``preexec_fn``, about
    which JAX warns, and leaves an incomplete file after an error.

    Args:
        path: path of the file. ``.mp4`` is added to a path without a suffix.
        fps: frames per second.
    """

    def __init__(self, path: str | Path, fps: float) -> None:
        path = Path(path)
        if path.suffix not in ("", ".mp4"):
            raise ValueError(f"path={str(path)!r} must end in .mp4, the only supported format")
        self.path = (path if path.suffix else path.with_name(path.name + ".mp4")).absolute()
        self.fps = fps
        self.n_frames = 0
        self._partial = self.path.with_name(f".{self.path.stem}.{os.getpid()}.partial.mp4")
        self._program = ffmpeg()
        self._process: subprocess.Popen[bytes] | None = None
        self._shape: tuple[int, ...] = ()

    def write(self, frame: np.ndarray) -> None:
        """Adds a frame, ``uint8 (height, width, 3)``. All frames must have the same shape."""
        if self._process is None:
            self._start(frame.shape)
        if frame.shape != self._shape or frame.dtype != np.uint8:
            raise ValueError(
                f"frame {self.n_frames} is {frame.dtype} of shape {frame.shape}, expected uint8 of shape {self._shape}"
            )
        assert self._process is not None
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(np.ascontiguousarray(frame).data)
        except OSError:
            self._fail()
        self.n_frames += 1

    def close(self) -> Path:
        """Completes the file, moves it to its path and returns the path.

        Raises:
            OSError: if it could not be written; an existing file is not changed.
            ValueError: if no frame was written.
        """
        if self._process is None:
            raise ValueError(f"{self.path} has no frames")
        assert self._process.stdin is not None
        try:
            self._process.stdin.close()
        except OSError:
            self._fail()
        if self._process.wait() != 0:
            self._fail()
        self._errors.close()
        os.replace(self._partial, self.path)
        return self.path

    def discard(self) -> None:
        """Discards the file."""
        if self._process is None:
            return
        self._process.kill()
        self._process.wait()
        assert self._process.stdin is not None
        with suppress(OSError):  # the process that reads has ended
            self._process.stdin.close()
        self._errors.close()
        self._partial.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()

    def _start(self, shape: tuple[int, ...]) -> None:
        self._shape = shape
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the video
        height, width = shape[:2]
        self._process = subprocess.Popen(
            [
                *(self._program, "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"),
                *("-s", f"{width}x{height}", "-r", str(self.fps), "-i", "-", "-an"),
                *("-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-c:v", "libx264", "-pix_fmt", "yuv420p"),
                *("-movflags", "+faststart", str(self._partial)),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            # Ctrl-C must not reach ffmpeg, so that the file can still be closed
            process_group=0 if os.name == "posix" else None,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
        )

    def _fail(self) -> None:
        assert self._process is not None
        self._process.wait()
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        self.discard()
        raise OSError(f"{self.path} could not be written; ffmpeg: {lines[-1] if lines else 'no message'}")


@dataclass(frozen=True)
class Html:
    """HTML text, in place of IPython's class if IPython is not installed."""

    data: str

    def _repr_html_(self) -> str:
        return self.data


def show_videos(folder: str | Path = "videos", prefix: str = "") -> Any:
    """Returns the mp4 files of a folder as HTML that a notebook shows.

    They are sorted by the numbers in their names. The videos are embedded, so they remain in the notebook when the files are
    deleted. Outside a notebook the HTML is in ``.data``.

    Args:
        folder: folder with the videos, without its subfolders.
        prefix: only files whose name starts with it.

    >>> show_videos("no-such-folder").data
    '<p>No mp4 file in no-such-folder.</p>'
    """
    files = [path for path in Path(folder).glob("*.mp4") if path.name.startswith(prefix) and path.name[0] != "."]
    files.sort(key=lambda path: by_number(path.name))
    text = "\n".join(_player(path) for path in files)
    if not files:
        named = f" whose name starts with {prefix}" if prefix else ""
        text = f"<p>No mp4 file{html.escape(named)} in {html.escape(str(folder))}.</p>"
    try:
        from IPython.display import HTML
    except ImportError:
        return Html(text)
    return HTML(text)


def by_number(name: str) -> list[tuple[int, int, str]]:
    """Returns a sort key that orders the numbers in names by their values.

    >>> sorted(["episode-10.mp4", "episode-9.mp4", "a.mp4"], key=by_number)
    ['a.mp4', 'episode-9.mp4', 'episode-10.mp4']
    """
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in re.split(r"(\d+)", name)]


def _player(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    return (
        f"<figure><video title='{html.escape(path.name)}' autoplay loop muted controls style='height: 400px;'>"
        f"<source src='data:video/mp4;base64,{data}' type='video/mp4'></video>"
        f"<figcaption>{html.escape(path.name)}</figcaption></figure>"
    )
