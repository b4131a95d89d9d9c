"""The interface of environments in JAX.

The state of an environment is a value: ``reset`` returns one and ``step`` returns the next, so both can be compiled, mapped
over many environments and put into a training program. The meaning of the returned values is that of gymnax 1.0.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from inspect import signature
from typing import Any

import equinox as eqx
import gymnasium as gym
import jax.numpy as jnp
from jax import Array

from rejeu.core.types import PyTree


class FunctionalEnv(eqx.Module):
    """An environment as pure functions. Its fields are its parameters.

    The functions must be traceable by ``jax.jit`` and ``jax.vmap``: no side effects, shapes that do not depend on values,
    ``jnp.where`` instead of ``if`` on arrays. They are written for one environment and mapped over many. Declare parameters
    that are no arrays with ``equinox.field(static=True)``; equal environments then share compiled functions.

    Nothing is reset by ``step``, and the returned observation is the true successor, also where the episode ends. The caller
    resets; see :func:`rejeu.envs.functional.vector.reset_done`.
    """

    max_episode_steps: eqx.AbstractVar[int | None]
    """The time limit in steps, None for none."""

    @property
    @abstractmethod
    def observation_space(self) -> gym.Space:
        """The space of the observations."""

    @property
    @abstractmethod
    def action_space(self) -> gym.Space:
        """The space of the actions that :meth:`step` takes."""

    @abstractmethod
    def reset(self, key: Array) -> tuple[PyTree, PyTree]:
        """Starts an episode.

        Args:
            key: a PRNG key.

        Returns:
            The state, any pytree of arrays, and the observation.
        """

    @abstractmethod
    def step(self, key: Array, state: PyTree, action: Array) -> tuple[PyTree, PyTree, Array, Array, Array]:
        """Steps the environment.

        Args:
            key: a PRNG key. Environments without randomness ignore it.
            state: the state. It is not changed.
            action: an action of the action space.

        Returns:
            The next state, its observation, the reward ``float[]``, ``terminated`` ``bool[]`` (the MDP ended) and
            ``truncated`` ``bool[]`` (the time limit was reached). The state must contain what it needs to count the time.
        """

    def success(self, state: PyTree) -> Array | None:
        """Returns whether the state is a success, ``bool[]``, or None if the environment does not define success."""
        return None

    def action_mask(self, state: PyTree) -> Array | None:
        """Returns which actions are allowed, ``bool (n_actions,)``, or None if all of them always are."""
        return None


class GoalEnv(FunctionalEnv):
    """An environment with goals, whose observations are dicts of ``observation``, ``achieved_goal`` and ``desired_goal``.

    Hindsight replay calls the functions below inside compiled code, with goals ``(..., goal_dim)`` and an empty info, which
    they need not take.
    """

    @abstractmethod
    def compute_reward(self, achieved_goal: Array, desired_goal: Array, info: object = None) -> Array:
        """Returns the rewards ``(...)`` of reaching ``achieved_goal`` when the goal is ``desired_goal``."""

    def compute_terminated(self, achieved_goal: Array, desired_goal: Array, info: object = None) -> Array | None:
        """Returns where the goals end the episode, ``bool (...)``; None if relabeled steps keep their termination flags."""
        return None


def of_two_goals(function: Callable[..., Any]) -> Callable[[Any, Any], Any]:
    """Returns ``compute_reward`` or ``compute_terminated`` as a function of two goals, with an empty info where one is taken.

    >>> of_two_goals(lambda achieved, desired, info: (achieved, desired, info))(1, 2)
    (1, 2, {})
    """
    calls: tuple[Callable[..., Any], ...] = (
        lambda function, *goals: function(*goals, info={}),
        lambda function, *goals: function(*goals, {}),
        lambda function, *goals: function(*goals),
    )
    for call in calls:
        with suppress(TypeError):
            call(signature(function).bind, None, None)
            break
    return partial(call, function)


def time_is_up(time: Array, max_episode_steps: int | None) -> Array:
    """Returns whether ``time``, the number of steps of the episode, has reached the time limit, ``bool[]``.

    >>> bool(time_is_up(jnp.array(200), 200)), bool(time_is_up(jnp.array(200), None))
    (True, False)
    """
    return jnp.zeros_like(time, bool) if max_episode_steps is None else time >= max_episode_steps
