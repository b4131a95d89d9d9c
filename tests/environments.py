"""Minimal environments shared by several tests."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Timed(gym.Env):
    """Episodes of ``length`` steps (None: without end); subclasses say what is observed and earned.

    ``begin`` is called at every reset, ``reward`` before ``time`` moves on, and ``observe`` and ``info`` after it.
    """

    observation_space: spaces.Space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space: spaces.Space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    length: int | None = 10
    ends = "truncated"

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        self.time = 0
        self.begin(seed)
        return self.observe(), self.info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        reward = self.reward(action)
        self.time += 1
        over = self.time == self.length
        return (
            self.observe(),
            reward,
            over and self.ends == "terminated",
            over and self.ends == "truncated",
            self.info(),
        )

    def begin(self, seed: int | None) -> None: ...

    def reward(self, action: Any) -> float:
        return 0.0

    def observe(self) -> Any:
        return np.zeros(self.observation_space.shape or (), np.float32)

    def info(self) -> dict:
        return {}


class Counter(gym.Env):
    """Observes its own state: (episode, time in the episode, a number sampled at reset).

    Episode ``i`` has ``lengths[i % len(lengths)]`` steps, and ``ends`` says how it ends. The reward is 100 times the
    episode plus the time. ``actions`` contains all actions received.
    """

    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)

    def __init__(
        self, lengths: tuple[int, ...] = (3,), ends: str = "truncated", low: Any = -1.0, high: Any = 1.0
    ) -> None:
        self.action_space = spaces.Box(np.float32(low), np.float32(high), np.shape(low) or (1,), np.float32)
        self.lengths = lengths
        self.ends = ends
        self.episode = -1
        self.time = 0
        self.drawn = 0.0
        self.actions: list[np.ndarray] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.episode += 1
        self.time = 0
        self.drawn = float(self.np_random.uniform())
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        assert not self._over(), "stepped after the end of the episode"
        self.actions.append(np.array(action))
        reward = 100.0 * self.episode + self.time
        self.time += 1
        over = self._over()
        return self._observe(), reward, over and self.ends == "terminated", over and self.ends == "truncated", {}

    def _over(self) -> bool:
        return self.time >= self.lengths[self.episode % len(self.lengths)]

    def _observe(self) -> np.ndarray:
        return np.array([self.episode, self.time, self.drawn], np.float32)


class Reach(gym.Env):
    """A goal environment: move a point on a line to a goal. 10 steps, or fewer if ``stops`` and the goal is reached."""

    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    observation_space = spaces.Dict(
        {key: spaces.Box(-20.0, 20.0, (1,), np.float32) for key in ("observation", "achieved_goal", "desired_goal")}
    )

    def __init__(self, stops: bool = False) -> None:
        self.stops = stops

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict, dict]:
        super().reset(seed=seed)
        self.position, self.goal = self.np_random.uniform(-2, 2, (2, 1)).astype(np.float32)
        self.time = 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        self.position = self.position + action
        self.time += 1
        reached = self.compute_reward(self.position, self.goal, {}) == 0.0
        info = {"is_success": bool(reached)}
        return self._observe(), float(reached) - 1.0, bool(self.stops and reached), self.time == 10, info

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        return (np.abs(achieved - desired)[..., 0] < 0.5).astype(np.float32) - 1.0

    def _observe(self) -> dict:
        return {"observation": self.position, "achieved_goal": self.position, "desired_goal": self.goal}


class Sampled(Timed):
    """Samples observations from any space. Rewards are 0 and episodes have 5 steps."""

    length = 5

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Space | None = None) -> None:
        self.observation_space = observation_space
        self.action_space = Timed.action_space if action_space is None else action_space

    def begin(self, seed: int | None) -> None:
        if seed is not None:
            self.observation_space.seed(seed)

    def observe(self) -> Any:
        return self.observation_space.sample()
