"""Advice on an environment of one's own: what would fail, and what would make learning needlessly hard."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env as check_gymnasium_env

from rejeu.spaces import leaves


def check_env(env: gym.Env, warn: bool = True, skip_render_check: bool = True) -> None:
    """Plays some steps of an environment and raises what is wrong with it; warns of what is unwise.

    Gymnasium's own checker runs first; it is strict, wants the environment without wrappers, and advises actions around
    [-1, 1]. Then come the things that learning needs: observations and actions that rejeu can take, finite ones, images as
    uint8 from 0 to 255.

    Args:
        env: an environment; it is reset and stepped, and left open.
        warn: whether to warn as well; errors are raised in any case.
        skip_render_check: leave out whether it renders in each of its modes.

    Raises:
        TypeError: if it is no Gymnasium environment, or a space is of a kind that cannot be learnt from.
        ValueError, AssertionError: for what else is wrong.

    >>> check_env(gym.make("Pendulum-v1").unwrapped, warn=False)
    """
    if not isinstance(env, gym.Env):
        raise TypeError(f"env must be a gymnasium.Env, got {type(env).__name__}")
    with warnings.catch_warnings():
        if not warn:
            warnings.simplefilter("ignore")
        check_gymnasium_env(env, skip_render_check=skip_render_check)
    leaves(env.observation_space)
    check_action_space(env.action_space)
    if isinstance(env.observation_space, spaces.Dict) and "desired_goal" in env.observation_space.spaces:
        check_goals(env)
    check_finite(env)
    if warn:
        for line in advice_on_observations(env.observation_space):
            warnings.warn(line, UserWarning, stacklevel=2)


def check_action_space(space: gym.Space) -> None:
    """Raises ``TypeError`` unless actions are of a kind that an agent can choose."""
    if not isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        raise TypeError(
            f"the action space is {space}; agents choose Box, Discrete, MultiDiscrete or MultiBinary actions"
        )


def check_goals(env: gym.Env) -> None:
    """Raises ``ValueError`` unless a goal environment has what hindsight replay needs."""
    space = env.observation_space
    assert isinstance(space, spaces.Dict)
    for key in ("observation", "achieved_goal", "desired_goal"):
        if key not in space.spaces:
            raise ValueError(f"observations with a desired_goal need {key!r} too, there are {', '.join(space.spaces)}")
    if not env.has_wrapper_attr("compute_reward"):
        raise ValueError(
            "observations with a desired_goal need the method compute_reward(achieved_goal, desired_goal, info)"
        )
    env.reset(seed=0)
    obs, reward, _, _, info = env.step(env.action_space.sample())
    again = env.get_wrapper_attr("compute_reward")(obs["achieved_goal"], obs["desired_goal"], info)
    if not np.isclose(float(reward), float(again)):
        raise ValueError(
            f"step gave the reward {reward}, and compute_reward of the same goals {again}; they must agree"
        )


def check_finite(env: gym.Env, n_steps: int = 10) -> None:
    """Raises ``ValueError`` at the first observation or reward of some random steps that is not finite."""
    env.action_space.seed(0)
    _check_numbers(env.reset(seed=0)[0], "reset's observation")
    for _ in range(n_steps):
        obs, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        _check_numbers(obs, "an observation")
        _check_numbers(float(reward), "a reward")
        if terminated or truncated:
            env.reset()


def _check_numbers(value: Any, what: str) -> None:
    if isinstance(value, dict | tuple):
        for part in value.values() if isinstance(value, dict) else value:
            _check_numbers(part, what)
        return
    array = np.asarray(value)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"{what} holds a number that is not finite: {value}")


def advice_on_observations(space: gym.Space, path: str = "") -> list[str]:
    """Returns what is unwise about an observation space, one sentence each."""
    where = f" under {path!r}" if path else ""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        found = []
        for key, part in parts:
            name = f"{path}.{key}".lstrip(".")
            if isinstance(part, spaces.Dict | spaces.Tuple):
                found.append(
                    f"the observation under {name!r} is nested; rejeu takes it, Stable-Baselines3 takes one level only"
                )
            found += advice_on_observations(part, name)
        return found
    if not isinstance(space, spaces.Box):
        return []
    if len(space.shape) == 3:
        return _advice_on_image(space, where)
    if len(space.shape) > 1:
        return [f"the observation{where} has the shape {space.shape}; arrays of two axes are flattened"]
    if space.dtype != np.float32 and space.dtype != np.uint8:
        return [f"the observation{where} has the dtype {space.dtype}; use float32, which it is turned into"]
    return []


def _advice_on_image(space: spaces.Box, where: str) -> list[str]:
    found = []
    if space.dtype != np.uint8:
        found.append(f"the image{where} has the dtype {space.dtype}; only uint8 images go through convolutions")
    elif np.any(space.low != 0) or np.any(space.high != 255):
        found.append(f"the image{where} has other bounds than 0 and 255; it is divided by 255 in any case")
    if min(sorted(space.shape)[1:]) < 36 and space.dtype == np.uint8:
        found.append(
            f"the image{where} has the shape {space.shape}; below 36x36 small convolutions are used, below 8x8 none"
        )
    return found
