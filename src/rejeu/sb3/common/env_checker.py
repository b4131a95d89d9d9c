"""The environment checker: the quick checks of rejeu, with the error that Stable-Baselines3's raises."""

from __future__ import annotations

import warnings

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rejeu.envs import checker, validation


def check_env(env: gym.Env, warn: bool = True, skip_render_check: bool = True) -> None:
    """Checks the spaces of an environment, resets and some random steps, for about a second.

    :func:`rejeu.check_env` plays whole episodes and finds more.

    Args:
        env: a Gymnasium environment.
        warn: warn of observations that are hard to learn from, and of actions whose bounds are not -1 and 1.
        skip_render_check: False renders once too.

    Raises:
        AssertionError: if it does not follow Gymnasium's interface, an observation is outside of its space, or continuous
            actions have no bounds.
    """
    try:
        faults = checker.errors_of(checker.quick_findings(env), warn=False)
    except TypeError as error:
        faults = [str(error)]
    actions = env.action_space if not faults and isinstance(env.action_space, spaces.Box) else None
    if actions is not None and not actions.is_bounded():
        faults = [f"the continuous actions {actions} must have finite bounds"]
    if not faults:
        observations = env.reset()[0], env.step(env.action_space.sample())[0]
        bounds_faults = [validation.bounds_fault(env.observation_space, obs) for obs in observations]
        faults = [fault[1] for fault in bounds_faults if fault is not None]
    if faults:
        raise AssertionError("\n".join(faults))
    if warn:
        advice = [*checker.advice_on_observations(env.observation_space, dtypes=False)]
        if actions is not None and not (np.all(actions.low == -1) and np.all(actions.high == 1)):
            advice.append(f"the actions {actions} are scaled for the policy; bounds of -1 and 1 are recommended")
        for text in advice:
            warnings.warn(text, UserWarning, stacklevel=2)
    if not skip_render_check and env.render_mode is not None:
        env.render()
