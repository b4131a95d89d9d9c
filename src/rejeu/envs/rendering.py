"""Rendering of environments to arrays, with and without a display."""

from __future__ import annotations

import ctypes.util
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import MappingProxyType
from typing import Any

import gymnasium as gym
import numpy as np

from rejeu.core import hardware
from rejeu.core.spaces import keeps_values
from rejeu.core.types import Arguments
from rejeu.envs.validation import describe_value

DEFAULT_FPS = 30.0
"""Frames per second of environments that declare none."""
RENDERING = threading.RLock()
"""One thread at a time renders: the drivers are chosen by variables of the process."""


def make_rendering_env(
    make: Callable[..., gym.Env], env_id: str, plain_kwargs: Arguments = MappingProxyType({})
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
    """Returns the environment's ``render_fps``, or 30."""
    return float(env.metadata.get("render_fps") or DEFAULT_FPS)


def rgb_frame(env: gym.Env) -> np.ndarray:
    """Returns a rendered frame, ``uint8 (height, width, 3)``; needs no display. Gray images get colors, alpha is left out.

    Raises:
        ValueError: if it renders anything else, or if MuJoCo has no OpenGL context.
    """
    with RENDERING, display_for_pygame(), explain_mujoco_errors(env):
        shown: Any = env.render()
    frame = shown[..., None] if isinstance(shown, np.ndarray) and shown.ndim == 2 else shown
    if isinstance(frame, np.ndarray) and frame.shape[2:] in ((1,), (3,), (4,)) and keeps_values(frame, np.uint8):
        return np.ascontiguousarray(np.broadcast_to(frame[..., :3], (*frame.shape[:2], 3)), np.uint8)
    raise ValueError(
        f"{env} cannot be recorded: render() returned {describe_value(shown)}, expected whole numbers from 0 to 255 of shape "
        "(height, width, 3); a gray image and one with alpha do as well"
    )


@contextmanager
def environment_variable(name: str, value: str | None) -> Iterator[None]:
    """Sets an environment variable, unless the value is None, and restores it at the end."""
    before = os.environ.get(name)
    if value is not None:
        os.environ[name] = value
    try:
        yield
    finally:
        os.environ.pop(name, None)
        if before is not None:
            os.environ[name] = before


@contextmanager
def display_for_pygame() -> Iterator[None]:
    """Lets pygame render without a display, by SDL's ``dummy`` driver; restores the environment variable at the end.

    While ``SDL_VIDEODRIVER=dummy`` is set, highway-env renders black frames. Therefore the variable is set only while pygame's
    display is opened, which is done here, since a drawing may import highway-env with its first picture.
    """
    hardware.quiet_sdl()
    name = "SDL_VIDEODRIVER"
    driver = os.environ.get(name, "dummy" if is_headless() else None)
    with environment_variable(name, driver):
        if driver == "dummy":
            with suppress(ImportError):
                from pygame import display

                if not display.get_init():
                    display.init()
                del os.environ[name]
        yield


@contextmanager
def headless_mujoco() -> Iterator[None]:
    """Lets MuJoCo render without a display, by EGL or OSMesa, unless ``MUJOCO_GL`` is set; restores it at the end."""
    driver = None
    if "mujoco" in sys.modules and "MUJOCO_GL" not in os.environ and is_headless():
        libraries = {"egl": "EGL", "osmesa": "OSMesa"}
        driver = next((name for name, library in libraries.items() if ctypes.util.find_library(library)), None)
    with environment_variable("MUJOCO_GL", driver):
        yield


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
        error_type = type(error)
        if (error_type.__module__, error_type.__name__) != ("mujoco", "FatalError"):
            raise
        opengl = os.environ.get("MUJOCO_GL")
        fix = "set the environment variable MUJOCO_GL=egl (or osmesa) before starting Python"
        if opengl is None:
            fix = f"install EGL (on Debian and Ubuntu libegl1) or OSMesa (libosmesa6), or {fix}"
        raise ValueError(
            f"{env} cannot be rendered: MuJoCo has no OpenGL context with MUJOCO_GL={opengl or '(unset)'}, expected a display "
            f"or an offscreen renderer; {fix}"
        ) from error
