"""Probe environments: each can be solved in seconds, and only if one particular thing works.

After "Debugging RL, Without the Agonizing Pain" (Andy Jones 2021). All have one number as observation and one as action, so
that they share compiled functions.
"""

from typing import Any

import gymnasium as gym
import numpy as np

from tests.environments import Timed


class Probe(Timed):
    """Episodes of ``length`` steps; subclasses say what is seen and what is earned."""

    action_space = gym.spaces.Box(0.0, 2.0, (1,), np.float32)
    length = 1
    ends = "terminated"

    def begin(self, seed: int | None) -> None:
        self.sign = float(self.np_random.choice([-1.0, 1.0]))

    def reward(self, action: np.ndarray) -> float:
        return self.earn(float(action[0]))

    def earn(self, action: float) -> float:
        return 1.0


class Constant(Probe):
    """Always earns 1, once: the critic must learn 1."""


class Endless(Probe):
    """Always earns 1; the time limit of one step is no end: the critic must learn 1 / (1 - gamma)."""

    ends = "truncated"


class Later(Probe):
    """Two steps, and only the second earns 1: the value of the first is gamma."""

    length = 2

    def observe(self) -> np.ndarray:
        return np.float32([min(self.time, 1)])

    def earn(self, action: float) -> float:
        return float(self.time == 1)


class ByAction(Probe):
    """The best action is 1.5, in bounds from 0 to 2: the actor must follow the critic, in the environment's range."""

    def earn(self, action: float) -> float:
        return 1.0 - 4.0 * (action - 1.5) ** 2


class BySightAndAction(Probe):
    """The best action is 1.5 where 1 is seen and 0.5 where -1 is: actor and critic must both use what is seen."""

    def observe(self) -> np.ndarray:
        return np.float32([self.sign])

    def earn(self, action: float) -> float:
        return 1.0 - 4.0 * (action - 1.0 - 0.5 * self.sign) ** 2


class Cut(Probe):
    """From -1 a step that earns nothing leads to 1, and there a step earns 1 and ends the episode.

    The first step ends the episode too, ``truncated`` by a time limit or ``terminated``: -1 is worth gamma, or 0. New
    episodes begin in either place, so that what follows a time limit is not what is seen after it.
    """

    def observe(self) -> np.ndarray:
        return np.float32([self.sign])

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        if self.sign > 0:
            return self.observe(), 1.0, True, False, {}
        self.sign = 1.0
        return self.observe(), 0.0, self.ends == "terminated", self.ends == "truncated", {}


class CutByLimit(Cut):
    """By a time limit."""

    ends = "truncated"


class Discretely(gym.ActionWrapper):
    """A probe with the actions 1, 2 and 3, which stand for 0.5, 1 and 1.5: the best action is one of them."""

    action_space = gym.spaces.Discrete(3, start=1)

    def action(self, action: Any) -> np.ndarray:
        assert self.action_space.contains(action), action
        return np.float32([action / 2.0])


class Doubly(gym.ActionWrapper):
    """A probe with two choices between 1 and 2; together they stand for 0.5, 1 and 1.5."""

    action_space = gym.spaces.MultiDiscrete([2, 2], start=[1, 1])

    def action(self, action: Any) -> np.ndarray:
        assert self.action_space.contains(action), action
        return np.float32([(action.sum() - 1) / 2.0])


class Bitwise(gym.ActionWrapper):
    """A probe with two bits; together they stand for 0.5, 1 and 1.5."""

    action_space = gym.spaces.MultiBinary(2)

    def action(self, action: Any) -> np.ndarray:
        assert self.action_space.contains(action), action
        return np.float32([(action.sum() + 1) / 2.0])
