"""An environment that shows only part of its state: ``rejeu/CartPoleNoVelocity-v0``."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control import CartPoleEnv
from gymnasium.wrappers import TransformObservation


def cart_pole_without_velocities(render_mode: str | None = None) -> gym.Env:
    """Returns Gymnasium's CartPole showing the cart's position and the pole's angle, not how fast they change.

    What to do depends on the velocities, so a policy must remember: an old test of memory (Wierstra et al. 2007, "Solving
    Deep Memory POMDPs with Recurrent Policy Gradients").

    >>> import rejeu
    >>> gym.make("rejeu/CartPoleNoVelocity-v0").observation_space.shape
    (2,)
    """
    env: gym.Env = CartPoleEnv(render_mode=render_mode)
    space = env.observation_space
    assert isinstance(space, gym.spaces.Box)
    shown = gym.spaces.Box(space.low[::2], space.high[::2], dtype=np.float32)
    return TransformObservation(env, lambda obs: obs[::2], shown)
