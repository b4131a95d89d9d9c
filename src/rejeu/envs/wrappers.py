"""A wrapper that treats time limits as terminal states, and ``rejeu/CartPoleNoVelocity-v0``, which is partially observable."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control import CartPoleEnv
from gymnasium.wrappers import TransformObservation


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


def cart_pole_without_velocities(render_mode: str | None = None) -> gym.Env:
    """Returns Gymnasium's CartPole without velocities: only cart position and pole angle are observed.

    The optimal action depends on the velocities, so a policy needs memory. This is an early benchmark of recurrent
    policies (Wierstra et al. 2007, "Solving Deep Memory POMDPs with Recurrent Policy Gradients").

    >>> import rejeu
    >>> gym.make("rejeu/CartPoleNoVelocity-v0").observation_space.shape
    (2,)
    """
    env: gym.Env = CartPoleEnv(render_mode=render_mode)
    space = env.observation_space
    assert isinstance(space, gym.spaces.Box)
    shown = gym.spaces.Box(space.low[::2], space.high[::2], dtype=np.float32)
    return TransformObservation(env, lambda obs: obs[::2], shown)
