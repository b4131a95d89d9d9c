"""The environment checker with Stable-Baselines3's assertions and warnings.

:func:`rejeu.check_env` plays whole episodes and finds more.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rejeu.core.spaces import GOAL_KEYS
from rejeu.sb3.common.preprocessing import is_image_space_channels_first

__all__ = ["check_env"]

FLAGS = "the `terminated` and `truncated` values must be booleans"


def require(condition: Any, message: str) -> None:
    """Raises ``AssertionError`` unless a condition holds."""
    if not condition:
        raise AssertionError(message)


def check_env(env: gym.Env, warn: bool = True, skip_render_check: bool = True) -> None:
    """Checks the spaces of an environment, a reset and some steps.

    Args:
        env: a Gymnasium environment.
        warn: warn of what is allowed and makes learning harder, or is not supported.
        skip_render_check: False renders once too, and warns of an environment without render mode that has some.

    Raises:
        AssertionError: if it does not follow Gymnasium's interface.
    """
    require(isinstance(env, gym.Env), f"your environment must inherit from gymnasium.Env, it is a {type(env).__name__}")
    for kind in ("observation", "action"):
        has = isinstance(getattr(env, f"{kind}_space", None), spaces.Space)
        require(has, f"the {kind} space must inherit from gymnasium.spaces.Space; set self.{kind}_space")
    observation_space, action_space = env.observation_space, env.action_space
    try:
        env.reset(seed=0)
    except TypeError as error:
        raise TypeError("The reset() method must accept a `seed` parameter") from error
    unsupported = [*unsupported_observations(observation_space)]
    if warn:
        advice = [*unsupported, *advice_on_observations(observation_space), *advice_on_actions(action_space)]
        for text in advice:
            warnings.warn(text, UserWarning, stacklevel=2)
    if isinstance(action_space, spaces.Box):
        require(
            np.all(np.isfinite(action_space.low)) and np.all(np.isfinite(action_space.high)),
            "Continuous action space must have a finite lower and upper bound",
        )
    if unsupported or isinstance(action_space, spaces.Dict | spaces.Tuple):
        return
    _check_returned(env, observation_space, action_space)
    if not skip_render_check and env.render_mode is not None:
        env.render()
    elif not skip_render_check and warn and env.metadata.get("render_modes"):
        warnings.warn(
            "the environment was made without render_mode, so that it is not rendered", UserWarning, stacklevel=2
        )


def unsupported_observations(space: spaces.Space, path: str = "") -> Iterator[str]:
    """Yields why agents of Stable-Baselines3 cannot learn from observations."""
    where = f" under {path!r}" if path else ""
    if isinstance(space, spaces.Graph | spaces.Sequence | spaces.OneOf | spaces.Text):
        yield f"{type(space).__name__} observation space{where} is not supported: it has no fixed size"
    if isinstance(space, spaces.Tuple):
        yield f"Tuple observation space{where} is not supported by Stable-Baselines3; rejeu takes it"
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = [*(space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces))]
        if any(isinstance(part, spaces.Dict | spaces.Tuple) for _, part in parts):
            yield "Nested observation spaces are not supported by Stable-Baselines3; rejeu takes them"
        for key, part in parts:
            yield from unsupported_observations(part, f"{path}.{key}".lstrip("."))


def advice_on_observations(space: spaces.Space, key: str = "") -> Iterator[str]:
    """Yields what may make learning from observations harder."""
    where = f" of {key!r}" if key else ""
    if isinstance(space, spaces.Dict):
        for name, part in space.spaces.items():
            yield from advice_on_observations(part, name)
    yield from advice_on_starts(space, f"observation{where}")
    if not isinstance(space, spaces.Box):
        return
    if len(space.shape) == 3:
        if space.dtype != np.uint8:
            yield f"an image observation{where} should have the dtype np.uint8, it has {space.dtype}"
        if np.any(space.low != 0) or np.any(space.high != 255):
            yield f"an image observation{where} should have the bounds [0, 255]"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            sides = space.shape[1:] if is_image_space_channels_first(space) else space.shape[:2]
        if min(sides) < 36:
            yield f"the image observation{where} is below 36x36 pixels, the least for the CNN; give a CNN of your own"
    elif len(space.shape) > 1:
        yield f"the observation{where} has the shape {space.shape}; it is recommended to flatten it to a vector"


def advice_on_starts(space: spaces.Space, what: str) -> Iterator[str]:
    """Yields what is unusual in Discrete and MultiDiscrete spaces."""
    if isinstance(space, spaces.MultiDiscrete) and len(space.shape) > 1:
        yield f"the {what} is MultiDiscrete with several axes, which Stable-Baselines3 does not support; flatten it"
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete) and np.any(space.start != 0):
        yield f"the {what} space does not start at 0, which Stable-Baselines3 does not support; wrap the environment"


def advice_on_actions(space: spaces.Space) -> Iterator[str]:
    """Yields what may make learning harder, or is not supported, in an action space."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        yield f"the action space {space} is not supported by Stable-Baselines3"
    yield from advice_on_starts(space, "action")
    if isinstance(space, spaces.Box):
        if np.any(np.equal(space.low, space.high)):
            yield "some bounds of the action space are equal, so that there is one action only"
        if np.any(np.abs(space.low) != np.abs(space.high)) or np.any(space.low != -1) or np.any(space.high != 1):
            yield "we recommend a symmetric and normalized Box action space (range=[-1, 1]); agents scale others"
        if space.dtype != np.float32:
            yield f"the action space has the dtype {space.dtype}; we recommend np.float32"


def _check_returned(env: gym.Env, observation_space: spaces.Space, action_space: spaces.Space) -> None:
    """Checks what ``reset``, ``step`` and ``compute_reward`` return."""
    answer: Any = env.reset()
    require(isinstance(answer, tuple) and len(answer) == 2, "reset() must return a tuple (obs, info)")
    obs, info = answer
    require(isinstance(info, dict), f"the second element of reset() must be a dict, it is {info!r:.60}")
    _check_observation(obs, observation_space, "reset")
    answer = env.step(action_space.sample())
    require(
        len(answer) == 5,
        f"step() must return obs, reward, terminated, truncated and info, it returned {len(answer)} values",
    )
    obs, reward, terminated, truncated, info = answer
    _check_observation(obs, observation_space, "step")
    require(
        isinstance(reward, int | float | np.floating | np.integer), f"the reward must be a number, it is {reward!r:.60}"
    )
    require(isinstance(terminated, bool | np.bool_) and isinstance(truncated, bool | np.bool_), FLAGS)
    require(isinstance(info, dict), f"the info of step() must be a dict, it is {info!r:.60}")
    if env.has_wrapper_attr("compute_reward"):
        keys = list(observation_space) if isinstance(observation_space, spaces.Dict) else []
        missing = [key for key in GOAL_KEYS if key not in keys]
        require(not missing, f"a goal environment needs Dict observations with {GOAL_KEYS}, {missing} is missing")
        again = env.get_wrapper_attr("compute_reward")(obs["achieved_goal"], obs["desired_goal"], info)
        require(float(again) == float(reward), f"compute_reward gave {again}, and step the reward {reward}")


def _check_observation(obs: Any, space: spaces.Space, method: str) -> None:
    """Raises ``AssertionError`` if an observation is not in its space, with the difference."""
    if isinstance(space, spaces.Dict):
        require(
            isinstance(obs, dict),
            f"the observation of {method}() must be a dict for {space}, it is {type(obs).__name__}",
        )
        keys = f"the keys of the observation of {method}() must be those of the space: {sorted(obs)} != {sorted(space.spaces)}"
        require(obs.keys() == space.spaces.keys(), keys)
        for key, part in space.spaces.items():
            try:
                _check_observation(obs[key], part, method)
            except AssertionError as error:
                raise AssertionError(f"Error while checking key={key}: {error}") from error
        return
    begin = f"The observation returned by the `{method}()` method does not match the space: "
    if isinstance(space, spaces.Discrete):
        require(isinstance(obs, int | np.integer | np.ndarray), f"{begin}it must be an int, it is {obs!r:.60}")
        require(not np.shape(obs), f"{begin}Expected: (), actual shape: {np.shape(obs)}")
    else:
        require(isinstance(obs, np.ndarray), f"{begin}it must be a numpy array, it is {type(obs).__name__}")
        require(obs.shape == space.shape, f"{begin}Expected: {space.shape}, actual shape: {obs.shape}")
    if isinstance(space, spaces.Box):
        require(np.can_cast(obs.dtype, space.dtype), f"{begin}Expected: {space.dtype}, actual dtype: {obs.dtype}")
        outside = (obs < space.low) | (obs > space.high)
        if len(wrong := np.argwhere(outside)):
            at = [
                f"Expected: {low} <= obs[{','.join(map(str, i))}] <= {high}, actual value: {value}"
                for i, low, high, value in zip(
                    wrong, space.low[outside], space.high[outside], obs[outside], strict=True
                )
            ]
            raise AssertionError(f"{begin}{len(at)} invalid indices:\n" + "\n".join(at))
    require(space.contains(obs), f"{begin}{obs!r:.60} is not in {space}")
