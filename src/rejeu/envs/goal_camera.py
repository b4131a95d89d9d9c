"""Where goals are in the picture that an environment has drawn, for maps of goals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from rejeu.envs.goals import attribute


def goal_camera(env: gym.Env) -> np.ndarray | None:
    """Returns how goals are projected into the last picture of an environment, ``(3, k + 1)``; None if that is unknown.

    The matrix maps the first ``k`` numbers of a goal and a 1 to ``(x w, y w, w)``, where x and y are pixels from the upper
    left corner; see :func:`project`. Known are highway-env's parking, MuJoCo's environments whose goals are places, and
    environments with an attribute ``goal_camera``.

    Raises:
        ValueError: if that attribute has another shape.
    """
    declared = attribute(env, "goal_camera")
    if declared is not None:
        camera = np.asarray(declared, float)
        if camera.ndim != 2 or len(camera) != 3:
            raise ValueError(
                f"goal_camera of {env} has the shape {camera.shape}, expected (3, k + 1) for k numbers of a goal"
            )
        return camera
    inner: Any = env.unwrapped
    config, renderer = getattr(inner, "config", None), getattr(inner, "mujoco_renderer", None)
    if isinstance(config, dict) and "scales" in config.get("observation", {}) and getattr(inner, "viewer", None):
        return from_above(inner.viewer.sim_surface, config["observation"]["scales"])
    viewer = getattr(renderer, "viewer", None)
    desired = getattr(getattr(env, "observation_space", None), "spaces", {}).get("desired_goal")
    if viewer is None or desired is None or desired.shape not in ((2,), (3,)):
        return None
    eyes, size = viewer.scn.camera, (viewer.viewport.width, viewer.viewport.height)
    position = np.mean([eye.pos for eye in eyes], axis=0)
    slope = eyes[0].frustum_top / eyes[0].frustum_near
    return perspective(position, eyes[0].forward, eyes[0].up, slope, size)[:, [*range(desired.shape[0]), 3]]


def goal_names(env: gym.Env, n: int) -> list[str]:
    """Returns names of the first ``n`` numbers of goals: an environment's own ``goal_names``, or their positions."""
    names = [str(name) for name in attribute(env, "goal_names") or ()]
    return [*names, *(f"number {i + 1} of the goal" for i in range(len(names), n))][:n]


def from_above(surface: Any, scales: Sequence[float]) -> np.ndarray:
    """Returns the camera of a surface of highway-env, for goals whose x and y are divided by ``scales``."""
    scaling, (x, y) = float(surface.scaling), (float(end) for end in surface.origin)
    return np.array([[scaling * scales[0], 0, -scaling * x], [0, scaling * scales[1], -scaling * y], [0, 0, 1]])


def perspective(
    position: np.ndarray, forward: np.ndarray, up: np.ndarray, slope: float, size: tuple[int, int]
) -> np.ndarray:
    """Returns the camera of a pinhole at a position, for goals in space.

    Args:
        position: of the pinhole.
        forward: direction of the view, of length 1.
        up: upper side of the picture, of length 1.
        slope: half the visible height at the distance 1.
        size: width and height of the picture in pixels.
    """
    width, height = size
    right, focal = np.cross(forward, up), 0.5 * height / slope
    axes = np.array([focal * right + 0.5 * width * forward, 0.5 * height * forward - focal * up])
    rows = np.vstack([axes, forward])
    return np.column_stack([rows, -rows @ position])


def project(camera: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Returns the pixels of goals, ``(n, 2)``; NaN where they are behind the camera or have too few numbers.

    >>> project(np.array([[2.0, 0.0, 5.0], [0.0, -2.0, 7.0], [0.0, 0.0, 1.0]]), np.array([[1.0, 3.0, 9.0]]))
    array([[7., 1.]])
    """
    k = camera.shape[1] - 1
    if goals.shape[1] < k:
        return np.full((len(goals), 2), np.nan)
    x, y, depth = camera @ np.column_stack([goals[:, :k], np.ones(len(goals))]).T
    depth = np.where(depth > 0, depth, np.nan)
    return np.column_stack([x / depth, y / depth])
