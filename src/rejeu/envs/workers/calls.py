"""Functions that ``SubprocVecEnv`` calls in worker processes. They are here so that no worker imports JAX."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from rejeu.envs import batching
from rejeu.envs.workers.process import checked_step

TERMINAL_OBSERVATION = "terminal_observation"
"""Key of the info that holds the last observation of an episode, as in Stable-Baselines3."""
TIME_LIMIT_TRUNCATED = "TimeLimit.truncated"
"""Key of the info that says whether only a time limit ended the episode."""


def reset(env: gym.Env, seed: int | None, options: dict[str, Any] | None) -> tuple[Any, dict[str, Any]]:
    """Resets an environment; returns a copy of the observation and the info."""
    obs, info = batching.reset_env(env, seed, options)
    return batching.copy_observation(env.observation_space, obs), info


def step_and_reset(env: gym.Env, action: Any) -> tuple[Any, float, bool, dict[str, Any], dict[str, Any]]:
    """Steps an environment, and resets it if the episode has ended.

    Returns:
        The observation to act on, the reward, whether the episode has ended, the info, and the info of the reset.
    """
    obs, reward, terminated, truncated, info = checked_step(env, action)
    obs = batching.copy_observation(env.observation_space, obs)
    info = {**info, TIME_LIMIT_TRUNCATED: truncated and not terminated}
    reset_info: dict[str, Any] = {}
    if terminated or truncated:
        info[TERMINAL_OBSERVATION] = obs
        obs, reset_info = reset(env, None, None)
    return obs, reward, terminated or truncated, info, reset_info


def get_attr(env: gym.Env, name: str) -> Any:
    """Returns an attribute, looked up through the wrappers."""
    return env.get_wrapper_attr(name)


def set_attr(env: gym.Env, name: str, value: Any) -> None:
    """Sets an attribute where it exists, also inside wrappers."""
    env.set_wrapper_attr(name, value)


def call_method(env: gym.Env, name: str, arguments: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
    """Calls a method, looked up through the wrappers, and returns its result."""
    return env.get_wrapper_attr(name)(*arguments, **keywords)
