"""The drawing of ``jax/Ball-v0``, which is that of ``rejeu/Ball-v0``."""

from __future__ import annotations

from typing import Any

import numpy as np

from rejeu.envs.ball.drawing import BallDrawing
from rejeu.envs.functional.ball import MAX_PUSH, WALL
from rejeu.envs.functional.drawing import Drawing, Scene


class BallScene(Drawing):
    """Draws the states of the ball in JAX."""

    fps = 30.0

    def __init__(self, env: Any, render_mode: str) -> None:
        """Prepares the drawing.

        Raises:
            MissingExtra: if pygame is not installed.
        """
        n_steps = env.max_episode_steps or 500
        self.drawing = BallDrawing(env.dimension, render_mode, self.fps, WALL, n_steps)

    def draw(self, scene: Scene) -> np.ndarray | None:
        trail = [state.position.tolist() for state in scene.states]
        push = [] if scene.action is None else np.clip(scene.action, -MAX_PUSH, MAX_PUSH).tolist()
        return self.drawing.draw(trail, push, int(scene.states[-1].time), scene.over)

    def close(self) -> None:
        self.drawing.close()
