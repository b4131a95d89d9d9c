"""Checks that an environment in JAX can be compiled and returns what its spaces declare."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import FrozenInstanceError
from typing import Any

import jax
import numpy as np
from gymnasium import spaces

from rejeu.core.errors import BadEnvironmentError
from rejeu.core.spaces import check_goal_space, leaves, narrow, structure
from rejeu.core.types import Observation, PyTree
from rejeu.core.validation import whole
from rejeu.envs.functional.protocol import FunctionalEnv, GoalEnv, of_two_goals

UNTRACEABLE = (jax.errors.JAXTypeError, jax.errors.JAXIndexError)
"""Errors of JAX where Python needs a value that is not known yet."""
MISTAKES = (TypeError, ValueError, FrozenInstanceError)
"""Errors of other mistakes, such as writing into an array or a field, or adding arrays whose shapes do not fit."""
N_GOALS = 3
"""Number of goals with which goal functions are checked."""


def check(env: FunctionalEnv) -> None:
    """Traces the functions of an environment; nothing is computed.

    Raises:
        BadEnvironmentError: if a function cannot be traced, or what it returns has another structure, shape or dtype than
            declared; in one line, with the fix.
        TypeError: if a space is of a kind that agents do not support.
        ValueError: if the time limit is no positive whole number.
    """
    name = type(env).__name__
    limit: Any = env.max_episode_steps
    if limit is not None:
        whole("max_episode_steps", limit.item() if isinstance(limit, np.generic) else limit, least=1)
    key = jax.eval_shape(lambda: jax.random.key(0))
    examples = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves(env.action_space)]
    action = jax.tree.unflatten(structure(env.action_space), examples)
    method = f"{name}.reset"
    state, obs = _unpack(_traced(method, env.reset, key), method, ("state", "obs"))
    _check_obs(method, env.observation_space, obs)
    method = f"{name}.step"
    values = _traced(method, env.step, key, state, action)
    after, obs, reward, *flags = _unpack(values, method, ("state", "obs", "reward", "terminated", "truncated"))
    _check_obs(method, env.observation_space, obs)
    _check_tree(method, "state", after, state, "as from reset")
    _check_array(method, "reward", reward, (), "f")
    for flag_name, flag in zip(("terminated", "truncated"), flags, strict=True):
        _check_array(method, flag_name, flag, (), "b")
    success = _traced(f"{name}.success", env.success, after)
    if success is not None:
        _check_array(f"{name}.success", "success", success, (), "b")
    mask = _traced(f"{name}.action_mask", env.action_mask, after)
    if mask is not None:
        _check_array(f"{name}.action_mask", "the mask", mask, getattr(mask, "shape", ())[:1] or (1,), "biu")
    if isinstance(env, GoalEnv):
        _check_goals(env, name)
    elif hasattr(env, "compute_reward"):
        raise BadEnvironmentError(
            f"{name} has compute_reward, but does not derive from rejeu.envs.functional.GoalEnv: derive it from GoalEnv, "
            "so that hindsight uses it, or rename the function"
        )


def _traced(method: str, function: Callable[..., Any], *arguments: object) -> Any:
    try:
        return jax.eval_shape(function, *arguments)
    except UNTRACEABLE as error:
        raise BadEnvironmentError(
            f"{method} cannot be compiled ({_line(error)}); it needs a value before there is one: use jnp instead of np, "
            "jnp.where instead of if, and no float(), int() or bool() of arrays"
        ) from error
    except MISTAKES as error:
        writes = isinstance(error, FrozenInstanceError) or "immutable" in str(error)
        fix = "; nothing may be changed in place: return new arrays" if writes else ""
        raise BadEnvironmentError(f"{method} cannot be compiled ({_line(error)}){fix}") from error


def _line(error: Exception) -> str:
    """Returns the kind of an error and the beginning of its message."""
    reason = str(error).partition("\n")[0].rstrip(".")
    return f"{type(error).__name__}: {reason[:150]}"


def _unpack(result: object, method: str, names: tuple[str, ...]) -> tuple[Any, ...]:
    if not isinstance(result, tuple) or len(result) != len(names):
        type_name = "array" if isinstance(result, jax.ShapeDtypeStruct) else type(result).__name__
        got = f"{len(result)} values" if isinstance(result, tuple) else f"one {type_name}"
        raise BadEnvironmentError(f"{method} returned {got}, expected ({', '.join(names)})")
    return result


def _check_obs(method: str, space: spaces.Space, obs: Observation) -> None:
    """Compares an observation with its space, but accepts 64-bit numbers, which occur with ``jax_enable_x64``."""
    declared = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves(space)]
    narrowed = jax.tree.map(lambda a: a if a.dtype == bool else jax.ShapeDtypeStruct(a.shape, narrow(a.dtype)), obs)
    expected = jax.tree.unflatten(structure(space), declared)
    _check_tree(method, "observation", narrowed, expected, "as in observation_space")


def _check_tree(method: str, name: str, returned: PyTree, expected: PyTree, source: str) -> None:
    """Compares the structures of trees, in which every array is an asterisk, and the shapes and dtypes of their arrays."""
    structures: list[Any] = [jax.tree.structure(tree) for tree in (returned, expected)]
    if structures[0] != structures[1]:
        texts = [str(tree).removeprefix("PyTreeDef(").removesuffix(")") for tree in structures]
        got, wanted = ("one array" if text == "*" else text[:200] for text in texts)
        raise BadEnvironmentError(f"{method} returned the {name} {got}, expected {wanted} {source}")
    pairs = zip(jax.tree_util.tree_leaves_with_path(expected), jax.tree.leaves(returned), strict=True)
    for (path, declared), array in pairs:
        if (declared.shape, declared.dtype) != (array.shape, array.dtype):
            raise BadEnvironmentError(
                f"{method} returned the {name}{jax.tree_util.keystr(path)} as {_shown(array)}, expected {_shown(declared)} "
                f"{source}: index it, or convert it with .astype"
            )


def _check_array(method: str, name: str, value: Any, shape: tuple[int, ...], dtype_kinds: str) -> None:
    """Checks the shape of an array, and that its dtype is of one of these kinds."""
    array = jax.eval_shape(lambda: value) if isinstance(value, bool | float | int) else value
    if getattr(array, "shape", None) != shape or np.dtype(array.dtype).kind not in dtype_kinds:
        dtype = "a float" if dtype_kinds == "f" else "a bool"
        axes = "for each action, with one axis" if shape else "without axes"
        raise BadEnvironmentError(
            f"{method} returned {name} as {_shown(array)}, expected {dtype} {axes}: index or convert it"
        )


def _shown(value: Any) -> str:
    """Returns dtype and shape of an array, and other values as text."""
    return f"{value.dtype}{list(value.shape)}" if hasattr(value, "shape") else f"{value!r:.60}"


def _check_goals(env: GoalEnv, name: str) -> None:
    try:
        check_goal_space(env.observation_space)
    except ValueError as error:
        raise BadEnvironmentError(f"{name}: {error}") from None
    goal = env.observation_space["achieved_goal"]  # type: ignore[index]
    goals = jax.ShapeDtypeStruct((N_GOALS, *goal.shape), narrow(goal.dtype))
    for function, may_be_none in ((env.compute_reward, False), (env.compute_terminated, True)):
        method = f"{name}.{function.__name__}"
        try:
            result = _traced(method, of_two_goals(function), goals, goals)
        except KeyError as error:
            raise BadEnvironmentError(
                f"{method} found no key {error}: environments in JAX have no infos; let it depend on the goals alone"
            ) from error
        if getattr(result, "shape", None) != (N_GOALS,) and not (result is None and may_be_none):
            got = f"the shape {result.shape}" if hasattr(result, "shape") else f"{result!r:.60}"
            raise BadEnvironmentError(
                f"{method} of {N_GOALS} goals returned {got}, expected the shape ({N_GOALS},): compute over the last axis, "
                "and return an array"
            )
