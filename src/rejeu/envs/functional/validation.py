"""Checks that an environment in JAX can be compiled and returns what its spaces declare."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from gymnasium import spaces

from rejeu.envs.functional.protocol import FunctionalEnv, GoalEnv
from rejeu.errors import BadEnvironmentError
from rejeu.spaces import check_goal_space, leaves, narrow, structure

UNTRACEABLE = (jax.errors.JAXTypeError, jax.errors.JAXIndexError)
"""What JAX raises where Python needs a value that is not known yet."""
N_GOALS = 3
"""Number of goals with which goal functions are checked."""


def check(env: FunctionalEnv) -> None:
    """Traces the functions of an environment; nothing is computed.

    Raises:
        BadEnvironmentError: if a function cannot be traced, or what it returns has another structure, shape or dtype than
            declared; in one line, with the fix.
        TypeError: if a space is of a kind that agents do not support.
    """
    name = type(env).__name__
    key = jax.eval_shape(lambda: jax.random.key(0))
    state, obs = _unpack(_traced(f"{name}.reset", env.reset, key), 2, f"{name}.reset", "(state, obs)")
    _check_obs(f"{name}.reset", env.observation_space, obs)
    said = f"{name}.step"
    after, obs, reward, terminated, truncated = _unpack(
        _traced(said, env.step, key, state, _action(env.action_space)),
        5,
        said,
        "(state, obs, reward, terminated, truncated)",
    )
    _check_obs(said, env.observation_space, obs)
    _check_state(said, state, after)
    _check_scalar(said, "reward", reward, "f")
    _check_scalar(said, "terminated", terminated, "b")
    _check_scalar(said, "truncated", truncated, "b")
    success = _traced(f"{name}.success", env.success, after)
    if success is not None:
        _check_scalar(f"{name}.success", "success", success, "b")
    if isinstance(env, GoalEnv):
        _check_goals(env, name)


def _traced(said: str, function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return jax.eval_shape(function, *arguments)
    except UNTRACEABLE as error:
        reason = str(error).partition("\n")[0].rstrip(".")
        raise BadEnvironmentError(
            f"{said} cannot be compiled ({type(error).__name__}: {reason[:150]}); it needs a value before there is one: use "
            "jnp instead of np, jnp.where instead of if, and no float(), int() or bool() of arrays"
        ) from error


def _unpack(answer: Any, n: int, said: str, expected: str) -> tuple[Any, ...]:
    if not isinstance(answer, tuple) or len(answer) != n:
        what = f"{len(answer)} values" if isinstance(answer, tuple) else f"a {type(answer).__name__}"
        raise BadEnvironmentError(f"{said} returned {what}, expected {expected}")
    return answer


def _action(space: spaces.Space) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(space.shape or (), narrow(space.dtype))


def _check_obs(said: str, space: spaces.Space, obs: Any) -> None:
    """Compares an observation with its space, but accepts 64-bit floats, which occur with ``jax_enable_x64``."""
    if jax.tree.structure(obs) != structure(space):
        raise BadEnvironmentError(
            f"{said} returned the observation {jax.tree.structure(obs)}, expected {structure(space)} as in observation_space"
        )
    for leaf, array in zip(leaves(space), jax.tree.leaves(obs), strict=True):
        where = f" under {leaf.path!r}" if leaf.path else ""
        if array.shape != leaf.shape:
            raise BadEnvironmentError(
                f"{said} returned an observation{where} of shape {array.shape}, expected {leaf.shape} as in observation_space"
            )
        if narrow(array.dtype) != leaf.dtype or array.dtype == bool:
            raise BadEnvironmentError(
                f"{said} returned an observation{where} of dtype {array.dtype}, expected {leaf.dtype}: "
                f"use .astype({leaf.dtype!r}), or declare the other dtype in observation_space"
            )


def _check_state(said: str, before: Any, after: Any) -> None:
    trees: list[Any] = [jax.tree.structure(before), jax.tree.structure(after)]
    if trees[0] != trees[1]:
        raise BadEnvironmentError(
            f"{said} returned a state of another structure than reset: {trees[1]}, expected {trees[0]}"
        )
    pairs = zip(jax.tree_util.tree_leaves_with_path(before), jax.tree.leaves(after), strict=True)
    for (path, old), new in pairs:
        if (old.shape, old.dtype) != (new.shape, new.dtype):
            raise BadEnvironmentError(
                f"{said} changed state{jax.tree_util.keystr(path)} from {old.dtype}{list(old.shape)} in reset to "
                f"{new.dtype}{list(new.shape)}; shapes and dtypes must stay the same"
            )


def _check_scalar(said: str, what: str, value: Any, kind: str) -> None:
    expected = {"f": "a float", "b": "a bool"}[kind]
    array = jax.eval_shape(lambda: value) if isinstance(value, bool | float | int) else value
    if not hasattr(array, "shape") or array.shape != () or np.dtype(array.dtype).kind != kind:
        got = f"{array.dtype}{list(array.shape)}" if hasattr(array, "shape") else f"{value!r:.60}"
        raise BadEnvironmentError(
            f"{said} returned {what} as {got}, expected {expected} without axes: index or convert it"
        )


def _check_goals(env: GoalEnv, name: str) -> None:
    try:
        check_goal_space(env.observation_space)
    except ValueError as error:
        raise BadEnvironmentError(f"{name}: {error}") from None
    goal = env.observation_space["achieved_goal"]  # type: ignore[index]
    goals = jax.ShapeDtypeStruct((N_GOALS, *goal.shape), narrow(goal.dtype))
    for function in (env.compute_reward, env.compute_terminated):
        said = f"{name}.{function.__name__}"
        result = _traced(said, function, goals, goals)
        if result is not None and getattr(result, "shape", None) != (N_GOALS,):
            raise BadEnvironmentError(
                f"{said} of {N_GOALS} goals returned the shape {getattr(result, 'shape', None)}, expected ({N_GOALS},); "
                "compute over the last axis"
            )
