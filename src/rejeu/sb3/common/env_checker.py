"""The environment checker: the quick checks of rejeu, with the error that Stable-Baselines3's raises."""

from __future__ import annotations

import warnings

import gymnasium as gym

from rejeu.envs import checker, validation

__all__ = ["check_env"]


def check_env(env: gym.Env, warn: bool = True, skip_render_check: bool = True) -> None:
    """Checks the spaces of an environment, resets and some random steps, for about a second.

    :func:`rejeu.check_env` plays whole episodes and finds more.

    Args:
        env: a Gymnasium environment.
        warn: warn of observations that are hard to learn from, and of actions without bounds.
        skip_render_check: False renders once too.

    Raises:
        AssertionError: if it does not follow Gymnasium's interface, or an observation is outside of its space.
    """
    try:
        faults = [one.text for one in checker.quick_findings(env) if one.level == "error"]
    except TypeError as error:
        faults = [str(error)]
    if not faults:
        seen = env.reset()[0], env.step(env.action_space.sample())[0]
        found = [validation.bounds_fault(env.observation_space, obs) for obs in seen]
        faults = [one[1] for one in found if one is not None]
    if faults:
        raise AssertionError("\n".join(faults))
    if warn:
        advice = checker.advice_on_observations(env.observation_space), checker.advice_on_actions(env.action_space)
        for text in (*advice[0], *advice[1]):
            warnings.warn(text, UserWarning, stacklevel=2)
    if not skip_render_check and env.render_mode is not None:
        env.render()
