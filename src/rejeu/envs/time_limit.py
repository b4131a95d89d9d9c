"""A wrapper that treats time limits as terminal states."""

from __future__ import annotations

from typing import Any

import gymnasium as gym


class TimeLimitTerminates(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """Reports truncated episodes as terminated, so that agents do not bootstrap from the last observation.

    Some older exercises treat the time limit this way: the last transition has no next state. This is correct if the
    limit is part of the task and the observation contains the remaining time. Otherwise, the same observation has a low
    value at one time and a high value at another. Without this wrapper, agents bootstrap through time limits.

    >>> env = TimeLimitTerminates(gym.make("MountainCar-v0", max_episode_steps=2))
    >>> _ = env.reset(seed=0)
    >>> [env.step(0)[2:4] for _ in range(2)]
    [(False, False), (True, False)]
    """

    def __init__(self, env: gym.Env) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Steps the environment, and reports truncation as termination."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        return obs, reward, terminated or truncated, False, info
