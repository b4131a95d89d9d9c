"""A time limit that counts as a terminal state."""

from __future__ import annotations

from typing import Any

import gymnasium as gym


class TimeLimitTerminates(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """Reports an episode that is cut off as one that has terminated, so that nothing is bootstrapped from its end.

    Some older exercises treat the limit so: their last transition has no next state. It is right where the limit belongs to
    the task, and the observation tells how much time is left. Elsewhere it teaches that the same observation is worth
    little at one time and much at another; without it agents bootstrap through limits.

    >>> env = TimeLimitTerminates(gym.make("MountainCar-v0", max_episode_steps=2))
    >>> _ = env.reset(seed=0)
    >>> [env.step(0)[2:4] for _ in range(2)]
    [(False, False), (True, False)]
    """

    def __init__(self, env: gym.Env) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Returns the environment's step, with truncated episodes as terminated ones."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        return obs, reward, terminated or truncated, False, info
