"""Generalized advantage estimation.

Source: Schulman et al. 2016, "High-Dimensional Continuous Control Using Generalized Advantage Estimation" (arXiv
1506.02438, equations 11 and 16). Each step has its own discount in place of a single gamma, so a time limit bootstraps
from the state in which it was reached and a terminal state does not bootstrap::

    delta_t = r_t + discount_t V(s'_t) - V(s_t)
    A_t     = delta_t + discount_t lambda A_{t+1},           without the last term where an episode or the rollout ends
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array


def advantages(
    reward: Array, value: Array, next_value: Array, discount: Array, ended: Array, gae_lambda: float
) -> Array:
    """Returns the generalized advantage estimates, ``(steps, n_envs)``.

    Args:
        reward: ``(steps, n_envs)``, like all other arrays.
        value: of the states in which the actions were taken.
        next_value: of their true successors, also where an episode ended.
        discount: gamma, and 0 where the MDP terminated.
        ended: where an episode ended, by a terminal state or a time limit.
        gae_lambda: in [0, 1]. With 1 the advantage is the discounted sum of rewards to the end of the episode (or, if it
            was truncated, up to there plus the value of the last state) minus the value; with 0 it is the TD error.
    """
    delta = reward + discount * next_value - value
    return summed_backwards(delta, jnp.where(ended, 0.0, gae_lambda * discount))


def summed_backwards(value: Array, factor: Array) -> Array:
    """Returns ``x_t = value_t + factor_t x_{t+1}``, ``(steps, n_envs)`` as both arguments; it begins with 0 after the last."""

    def back(following: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        value, factor = step
        result = value + factor * following
        return result, result

    return jax.lax.scan(back, jnp.zeros_like(value[0]), (value, factor), reverse=True)[1]
