"""The bit-flipping environment (Andrychowicz et al. 2017, arXiv 1707.01495, section 3.1)."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class BitFlipping(gym.Env):
    """A goal environment: state and goal are sampled at every reset, and each action flips one of ``n_bits``.

    The reward is 0 and the episode terminates if the state equals the goal; otherwise the reward is -1. Episodes are
    truncated after ``max_steps`` (None: ``n_bits``). The reward does not depend on the distance to the goal.
    """

    def __init__(self, n_bits: int = 10, max_steps: int | None = None) -> None:
        keys = ("observation", "achieved_goal", "desired_goal")
        self.observation_space = spaces.Dict({key: spaces.MultiBinary(n_bits) for key in keys})
        self.action_space = spaces.Discrete(n_bits)
        self.n_bits = n_bits
        self.max_steps = n_bits if max_steps is None else max_steps

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict[str, np.ndarray], dict]:
        super().reset(seed=seed)
        self.state, self.goal = self.np_random.integers(0, 2, (2, self.n_bits), dtype=np.int8)
        self.time = 0
        return self._observe(), {}

    def step(self, action: int) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, bool]]:
        self.state = self.state.copy()
        self.state[action] ^= 1
        self.time += 1
        success = bool(self.compute_terminated(self.state, self.goal, {}))
        truncated = self.time >= self.max_steps and not success
        return self._observe(), float(success) - 1.0, success, truncated, {"is_success": success}

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """Returns 0 where state and goal are equal and -1 elsewhere, ``(...)`` for goals ``(..., n_bits)``."""
        return self.compute_terminated(achieved_goal, desired_goal, info).astype(np.float32) - 1.0

    def compute_terminated(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """Returns where state and goal are equal."""
        return (achieved_goal == desired_goal).all(axis=-1)

    def _observe(self) -> dict[str, np.ndarray]:
        return {"observation": self.state, "achieved_goal": self.state, "desired_goal": self.goal}
