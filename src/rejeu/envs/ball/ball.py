"""The ball: keep a randomly pushed ball inside a box by pushing back. Registered as ``rejeu/Ball-v0``."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rejeu.envs.ball.drawing import BallDrawing

if TYPE_CHECKING:
    from rejeu.reporting.figures import Picture

WALL = 10.0
"""The box is [-WALL, WALL] in every dimension."""
STRONGEST_PUSH = 2.0
"""Actions are in [-STRONGEST_PUSH, STRONGEST_PUSH], and so are the starting positions."""
N_STEPS = 500
"""Steps for which the ball is to be held."""
HELD_REWARD, LOST_REWARD = 50.0, -10.0
"""Rewards of the last step of an episode; every other step gives 1."""


class Ball(gym.Env[np.ndarray, np.ndarray]):
    """A ball that is pushed about at random, and an agent that pushes it back.

    ==================  ==========================================================================================
    observation         the position, ``float32 (dimension,)`` in [-10, 10]
    action              the push, ``float32 (dimension,)`` in [-2, 2]; what is beyond is clipped
    start               the position is uniform in [-2, 2]
    step                ``position + action + sigma N(0, 1)``
    reward              1; -10 where the ball leaves the box; 50 at step 500 if it is held until then
    end                 *terminated* where it leaves the box, *truncated* at step 500
    info                ``is_success`` in the last step of an episode: whether it was held for all 500 steps
    ==================  ==========================================================================================

    An episode that is held returns 549. In two dimensions the policy ``clip(-x, -2, 2)`` holds all episodes for
    ``sigma=1``, 89 in 100 for ``sigma=2`` and none for ``sigma=3``.

    The 500th step is a time limit and no end of the task: nothing in the position tells that it comes, so a value that
    stopped there could not be learned. Algorithms bootstrap from it, as the course from which the environment is
    taken (``Bille_Env``) does by ignoring all ends. Mended against the course: the position that is tested for having
    left is the new one and not that of the step before; leaving therefore costs at once, and the time limit comes after
    500 steps rather than 501; a ball that leaves in the last step is lost; the episode is not reset behind the agent's
    back, so that it sees the position that ended it (on the wall where it went through); and an action out of range is
    clipped, not refused, since noise and rounding produce them.

    Args:
        dimension: of the box.
        sigma: standard deviation of the random push in each dimension and step.
        render_mode: ``"rgb_array"`` or ``"human"``; one dimension is drawn as position against time, two as a plane,
            more as the plane of the first two beside every coordinate against time (the first ten).

    Raises:
        ValueError: for a dimension below 1, a negative sigma or an unknown render mode.

    >>> import gymnasium as gym, rejeu
    >>> env = gym.make("rejeu/Ball-v0", dimension=2, sigma=1.0)
    >>> position, info = env.reset(seed=0)
    >>> position, reward, terminated, truncated, info = env.step(-position)
    >>> reward
    1.0
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 30}

    def __init__(self, dimension: int = 2, sigma: float = 1.0, render_mode: str | None = None) -> None:
        if isinstance(dimension, bool) or not isinstance(dimension, int) or dimension < 1:
            raise ValueError(f"dimension={dimension!r} must be a whole number of at least 1")
        if isinstance(sigma, bool) or not isinstance(sigma, int | float) or not 0 <= sigma < math.inf:
            raise ValueError(f"sigma={sigma!r} must be a finite number of at least 0")
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode={render_mode!r} must be None, 'human' or 'rgb_array'")
        self.dimension = dimension
        self.sigma = float(sigma)
        self.render_mode = render_mode
        self.observation_space = spaces.Box(-WALL, WALL, (dimension,), np.float32)
        self.action_space = spaces.Box(-STRONGEST_PUSH, STRONGEST_PUSH, (dimension,), np.float32)
        self.position: list[float] = []
        """Where the ball is; empty before the first reset. Beyond the wall once it has left."""
        self.n_steps = 0
        """Steps taken in this episode."""
        self.needs_reset = True
        """Whether a reset is due."""
        self._trail: deque[tuple[float, ...]] = deque(maxlen=N_STEPS + 1)
        self._push: list[float] = []
        self._drawing: BallDrawing | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode; returns the position and an empty info."""
        super().reset(seed=seed)
        self.position = self.np_random.uniform(-STRONGEST_PUSH, STRONGEST_PUSH, self.dimension).tolist()
        self.n_steps = 0
        self.needs_reset = False
        self._trail.clear()
        self._trail.append(tuple(self.position))
        self._push = []
        self._show()
        return self._observe(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Pushes the ball; see the class.

        Raises:
            gymnasium.error.ResetNeeded: if the episode is over or has not begun.
            ValueError: if the action has another shape or is not a number.
        """
        if self.needs_reset:
            raise gym.error.ResetNeeded("the episode is over or has not begun: call reset() before step()")
        push = np.asarray(action, np.float64)
        if push.shape != (self.dimension,):
            raise ValueError(f"the action has the shape {push.shape}, expected ({self.dimension},)")
        pushes = [min(max(p, -STRONGEST_PUSH), STRONGEST_PUSH) for p in push.tolist()]
        kicks = self.np_random.standard_normal(self.dimension).tolist()
        position = [x + p + self.sigma * k for x, p, k in zip(self.position, pushes, kicks, strict=True)]
        lost = not all(-WALL <= x <= WALL for x in position)
        if lost and any(p != p for p in pushes):
            raise ValueError(f"the action {push} is not a number; the policy has diverged")
        self.position = position
        self.n_steps += 1
        held = not lost and self.n_steps >= N_STEPS
        self.needs_reset = lost or held
        self._trail.append(tuple(position))
        self._push = pushes
        self._show()
        reward = LOST_REWARD if lost else HELD_REWARD if held else 1.0
        return self._observe(), reward, lost, held, {"is_success": held} if self.needs_reset else {}

    @property
    def trajectory(self) -> np.ndarray:
        """The positions of the episode so far, ``float64 (n_steps + 1, dimension)``, where it left the box included."""
        return np.array(self._trail, np.float64).reshape(-1, self.dimension)

    def plot(self, path: str | Path | None = None) -> Picture:
        """Returns :attr:`trajectory` as a matplotlib figure, shown by notebooks; see :mod:`rejeu.reporting.plots`.

        Raises:
            MissingExtra: if matplotlib is not installed.
            ValueError: before the first reset.
        """
        from rejeu.reporting import plots

        return plots.trajectory(self.trajectory, path, low=-WALL, high=WALL)

    def get_state(self) -> dict[str, Any]:
        """Returns everything that the further course depends on, as JSON values; :meth:`set_state` puts it back."""
        return {
            "position": list(self.position),
            "n_steps": self.n_steps,
            "over": self.needs_reset,
            "rng": self.np_random.bit_generator.state,
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continues where :meth:`get_state` was called, exactly; the trajectory begins here.

        Raises:
            ValueError: if the state is of another dimension, or no episode can stand there.
        """
        if len(state["position"]) not in (0, self.dimension):
            raise ValueError(f"the state is of {len(state['position'])} dimensions and this ball has {self.dimension}")
        position = [float(x) for x in state["position"]]
        n_steps, over = int(state["n_steps"]), bool(state["over"])
        inside = all(-WALL <= x <= WALL for x in position) and position and 0 <= n_steps < N_STEPS
        if not (over or inside) or not all(map(math.isfinite, position)):
            raise ValueError(f"no ball is under way at {position} after {n_steps} steps")
        self.np_random.bit_generator.state = state["rng"]
        self.position, self.n_steps, self.needs_reset = position, n_steps, over
        self._trail.clear()
        self._push = []
        if self.position:
            self._trail.append(tuple(self.position))

    def render(self) -> np.ndarray | None:
        """Returns the picture, ``uint8 (height, width, 3)``, or None where it is shown on the screen.

        Raises:
            ValueError: if it was made without a render mode.
            MissingExtra: if pygame is not installed.
        """
        if self.render_mode is None:
            raise ValueError("nothing is drawn without a render mode: gymnasium.make(..., render_mode='rgb_array')")
        if self._drawing is None:
            self._drawing = BallDrawing(self.dimension, self.render_mode, self.metadata["render_fps"], WALL, N_STEPS)
        return self._drawing.draw(self._trail, self._push, self.n_steps, self.needs_reset)

    def close(self) -> None:
        """Closes the window, if there is one."""
        if self._drawing is not None:
            self._drawing.close()
            self._drawing = None

    def _show(self) -> None:
        if self.render_mode == "human":
            self.render()

    def _observe(self) -> np.ndarray:
        """Returns the position; where the ball has left, the nearest point of the box."""
        if self.needs_reset:
            return np.array([min(max(x, -WALL), WALL) for x in self.position], np.float32)
        return np.array(self.position, np.float32)
