"""Video files: H.264 in mp4, written frame by frame by ffmpeg."""

from __future__ import annotations

import os
import subprocess
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from rejeu.errors import MissingExtra

HOLD_SECONDS = 0.5
"""How long the last frame of an episode is shown."""


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
    """An mp4 file that appears at its path when it is closed.

    H.264, yuv420p; odd heights and widths are padded by a black line. As a context manager it is closed at the end, or
    discarded after an exception. ``imageio_ffmpeg.write_frames`` is not used: it ignores ffmpeg's exit status, so that a full
    disk leaves half a video without an error, and it forks while JAX's threads run, about which JAX warns.

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
        os.replace(self._partial, self.path)
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
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
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
                *("-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-c:v", "libx264", "-pix_fmt", "yuv420p"),
                *("-movflags", "+faststart", str(self._partial)),
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
