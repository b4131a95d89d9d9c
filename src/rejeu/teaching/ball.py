"""The environment ``rejeu/Ball-v0``: keep a randomly moving ball inside a box."""

from __future__ import annotations

import math
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rejeu.core.types import Action, Info, JsonObject
from rejeu.core.validation import number
from rejeu.envs.canvas import Scene
from rejeu.envs.functional.ball_drawing import HELD_REWARD, LOST_REWARD, MAX_PUSH, WALL, BallDrawing

if TYPE_CHECKING:
    from rejeu.logs.plots.picture import Picture

N_STEPS = 500
"""Time limit of an episode, in steps."""


class Moment(NamedTuple):
    """A state of an episode, to be drawn."""

    position: tuple[float, ...]
    time: int


class Ball(gym.Env[np.ndarray, np.ndarray]):
    """A ball moves randomly, and the agent pushes it to keep it inside a box.

    ==================  ==========================================================================================
    observation         the position, ``float32 (dimension,)`` in [-10, 10]
    action              the push, ``float32 (dimension,)`` in [-2, 2]; clipped to this range
    initial state       the position is uniform in [-2, 2]
    dynamics            the next position is ``position + action + sigma N(0, 1)``
    reward              1 per step; -10 if the ball leaves the box; 50 at step 500 if it is still inside
    episode end         *terminated* if the ball leaves the box, *truncated* at step 500
    info                ``is_success`` in the last step of an episode: whether it stayed inside for 500 steps
    ==================  ==========================================================================================

    The return of a successful episode is 549. In two dimensions, the policy ``clip(-x, -2, 2)`` succeeds in all
    episodes for ``sigma=1``, in 89 of 100 for ``sigma=2`` and in none for ``sigma=3``.

    Step 500 is a time limit and not a terminal state. The observation does not contain the time, so a value function
    that treats this step as terminal cannot be learned. Algorithms therefore bootstrap from the last observation.

    The environment is a corrected version of ``Bille_Env`` from a course, where all episode ends are ignored in the
    targets. The differences are:

    - The new position is tested for leaving the box, not the previous one. The penalty is therefore immediate, and the
      time limit is 500 steps, not 501.
    - A ball that leaves the box in the last step is lost.
    - The episode is not reset automatically. The agent observes the final position, clipped to the box.
    - Actions out of range are clipped, because noise and rounding produce them. They do not raise an exception.

    Args:
        dimension: number of dimensions of the box.
        sigma: standard deviation of the random displacement in each dimension, per step.
        render_mode: ``"rgb_array"`` or ``"human"``. One dimension is drawn as position against time, two as a plane.
            More are drawn as the plane of the first two, next to plots of the first ten coordinates against time.

    Raises:
        ValueError: for a dimension below 1, a negative or infinite ``sigma``, or an unknown render mode.

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
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode={render_mode!r} must be None, 'human' or 'rgb_array'")
        self.dimension = dimension
        self.sigma = number("sigma", sigma, least=0)
        self.render_mode = render_mode
        self.observation_space = spaces.Box(-WALL, WALL, (dimension,), np.float32)
        self.action_space = spaces.Box(-MAX_PUSH, MAX_PUSH, (dimension,), np.float32)
        self.position: list[float] = []
        """Position of the ball, not clipped to the box. Empty before the first reset."""
        self.n_steps = 0
        """Number of steps of this episode."""
        self.over = True
        """Whether the episode has ended, or none has begun."""
        self._trail: deque[tuple[float, ...]] = deque(maxlen=N_STEPS + 1)
        self._push: list[float] = []
        self._drawing: BallDrawing | None = None

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[np.ndarray, Info]:
        """Starts an episode. Returns the position and an empty info."""
        super().reset(seed=seed)
        self.position = self.np_random.uniform(-MAX_PUSH, MAX_PUSH, self.dimension).tolist()
        self.n_steps = 0
        self.over = False
        self._trail.clear()
        self._trail.append(tuple(self.position))
        self._push = []
        self._show()
        return self._observe(), {}

    def step(self, action: Action) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Pushes the ball, see the class.

        Raises:
            gymnasium.error.ResetNeeded: if the episode is over or has not begun.
            ValueError: if the shape of the action is wrong, or if it contains NaN.
        """
        if self.over:
            raise gym.error.ResetNeeded("the episode is over or has not begun: call reset() before step()")
        push = np.asarray(action, np.float64)
        if push.shape != (self.dimension,):
            raise ValueError(f"the action has the shape {push.shape}, expected ({self.dimension},)")
        pushes = [min(max(p, -MAX_PUSH), MAX_PUSH) for p in push.tolist()]
        kicks = self.np_random.standard_normal(self.dimension).tolist()
        position = [x + p + self.sigma * k for x, p, k in zip(self.position, pushes, kicks, strict=True)]
        lost = not all(-WALL <= x <= WALL for x in position)
        if lost and any(p != p for p in pushes):
            raise ValueError(f"the action {push} is not a number; the policy has diverged")
        self.position = position
        self.n_steps += 1
        held = not lost and self.n_steps >= N_STEPS
        self.over = lost or held
        self._trail.append(tuple(position))
        self._push = pushes
        self._show()
        reward = LOST_REWARD if lost else HELD_REWARD if held else 1.0
        return self._observe(), reward, lost, held, {"is_success": held} if self.over else {}

    @property
    def trajectory(self) -> np.ndarray:
        """The positions of the current episode, ``float64 (n_steps + 1, dimension)``, not clipped to the box."""
        return np.array(self._trail, np.float64).reshape(-1, self.dimension)

    def plot(self, path: str | Path | None = None) -> Picture:
        """Plots :attr:`trajectory` as a matplotlib figure, which notebooks display. See :mod:`rejeu.logs.plots`.

        Raises:
            MissingExtra: if matplotlib is not installed.
            ValueError: before the first reset.
        """
        from rejeu.logs import plots

        return plots.trajectory(self.trajectory, path, low=-WALL, high=WALL)

    @property
    def needs_reset(self) -> bool:
        """Whether the environment must be reset before the next step."""
        return self.over

    def get_state(self) -> JsonObject:
        """Returns the state, including the random number generator, as JSON values, for :meth:`set_state`."""
        return {
            "position": list(self.position),
            "n_steps": self.n_steps,
            "over": self.over,
            "rng": self.np_random.bit_generator.state,
        }

    def set_state(self, state: JsonObject) -> None:
        """Restores a state of :meth:`get_state`. The trajectory starts at its position.

        Raises:
            ValueError: if the state has another dimension, or cannot occur in an episode.
        """
        if len(state["position"]) not in (0, self.dimension):
            raise ValueError(f"the state is of {len(state['position'])} dimensions and this ball has {self.dimension}")
        position = [float(x) for x in state["position"]]
        n_steps, over = int(state["n_steps"]), bool(state["over"])
        inside = all(-WALL <= x <= WALL for x in position) and position and 0 <= n_steps < N_STEPS
        if not (over or inside) or not all(map(math.isfinite, position)):
            raise ValueError(f"no ball is under way at {position} after {n_steps} steps")
        self.np_random.bit_generator.state = state["rng"]
        self.position, self.n_steps, self.over = position, n_steps, over
        self._trail.clear()
        self._push = []
        if self.position:
            self._trail.append(tuple(self.position))

    def render(self) -> np.ndarray | None:
        """Returns an image, ``uint8 (height, width, 3)``, or None if it is shown in a window.

        Raises:
            ValueError: if the environment was made without a render mode.
            MissingExtra: if pygame is not installed.
        """
        if self.render_mode is None:
            raise ValueError("nothing is drawn without a render mode: gymnasium.make(..., render_mode='rgb_array')")
        if self._drawing is None:
            self._drawing = BallDrawing(self.dimension, N_STEPS, self.render_mode)
        first = self.n_steps - len(self._trail) + 1
        states = [Moment(position, first + i) for i, position in enumerate(self._trail)]
        return self._drawing.draw(Scene(states, self._push or None, self.over))

    def close(self) -> None:
        """Closes the window if there is one."""
        if self._drawing is not None:
            self._drawing.close()
            self._drawing = None

    def _show(self) -> None:
        if self.render_mode == "human":
            self.render()

    def _observe(self) -> np.ndarray:
        """Returns the position, clipped to the box."""
        if self.over:
            return np.array([min(max(x, -WALL), WALL) for x in self.position], np.float32)
        return np.array(self.position, np.float32)
