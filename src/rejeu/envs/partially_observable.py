"""A partially observable environment: ``rejeu/CartPoleNoVelocity-v0``."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control import CartPoleEnv
from gymnasium.wrappers import TransformObservation


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
