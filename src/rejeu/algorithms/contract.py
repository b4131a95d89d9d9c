"""Checks of what the functions of an algorithm return. They run while JAX traces, so they take no time in training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array

from rejeu.core.algorithm import TD_ERROR, Action, Algorithm, Clock, Metrics, PyTree, names
from rejeu.core.spaces import random_action


def checked(algorithm: Algorithm, action_space: spaces.Space) -> Algorithm:
    """Returns an algorithm whose functions raise ``TypeError`` if they do not return what :class:`Algorithm` says."""
    sample = random_action(action_space, 1, np.random.default_rng(0))

    def explore(actor: PyTree, obs: PyTree, key: Array, clock: Clock) -> Array:
        action = algorithm.explore(actor, obs, key, clock)
        check_action(action, obs, sample, "explore")
        return action

    def exploit(actor: PyTree, obs: PyTree) -> Array:
        action = algorithm.exploit(actor, obs)
        check_action(action, obs, sample, "exploit")
        return action

    def update(state: PyTree, batch: PyTree, clock: Clock) -> tuple[PyTree, Metrics]:
        returned = algorithm.update(state, batch, clock)
        check_update(returned)
        check_state(returned[0], state, "update")
        return returned

    return algorithm._replace(explore=explore, exploit=exploit, update=update)


def check_config(config: Any) -> None:
    """Raises ``TypeError`` if the class of a configuration overrides ``__post_init__`` without calling that of its base."""
    if not config.is_checked:
        raise TypeError(
            f"{type(config).__name__}.__post_init__ of {config.name or 'an algorithm'} does not call "
            "super().__post_init__(), which checks and converts the other hyperparameters; begin it with this call"
        )


def check_action(action: Action, obs: PyTree, sample: np.ndarray, function: str) -> None:
    """Raises ``TypeError`` if actions for the observations ``obs`` differ in shape or kind from ``sample``.

    Args:
        action: what ``function`` returned.
        obs: leaves ``(batch, ...)``.
        sample: an action of the space in the range of algorithms, with a leading axis.
        function: the name of the function, for the message.
    """
    shape, is_float = (len(jax.tree.leaves(obs)[0]), *sample.shape[1:]), sample.dtype.kind == "f"
    dtype = getattr(action, "dtype", None)
    if dtype is None or action.shape != shape or jnp.issubdtype(dtype, jnp.floating) != is_float:
        dtype = "float32" if is_float else "int32"
        raise TypeError(
            f"{function} returned the actions {described(action)}, expected {dtype}{[*shape]}: one for each of the {shape[0]} "
            "observations of its batch" + (", in [-1, 1]" if is_float else ", counted from 0")
        )


def check_update(returned: object) -> None:
    """Raises ``TypeError`` unless ``update`` returned a state and a dict of scalars."""
    if not isinstance(returned, tuple) or len(returned) != 2 or not isinstance(returned[1], Mapping):
        items = returned if isinstance(returned, tuple) else (returned,)
        raise TypeError(
            f"update returned ({', '.join(type(item).__name__ for item in items)}), expected (state, metrics): the "
            "new state and a dict of scalars, which may be empty"
        )
    for name, value in returned[1].items():
        if name != TD_ERROR and np.shape(value) != ():
            raise TypeError(
                f"update returned the metric {name!r} as {described(value)}, expected a scalar: take its mean"
            )


def check_state(state: PyTree, expected: PyTree, function: str) -> None:
    """Raises ``TypeError`` if a leaf of a state differs in shape or dtype from that of ``expected``.

    ``function`` is that of the algorithm which returned the state.
    """
    returned, wanted = (dict(zip(names(tree), jax.tree.leaves(tree), strict=True)) for tree in (state, expected))
    for name in [*wanted, *returned]:
        ours, theirs = (described(leaves[name]) if name in leaves else "no such leaf" for leaves in (wanted, returned))
        if ours != theirs:
            raise TypeError(f"{function} returned a state with {name or 'state'}: {theirs}, expected an array {ours}")


def described(value: Any) -> str:
    """Returns dtype and shape of an array as text, and any other value as it is.

    >>> described(jnp.zeros((2, 3))), described(0.5)
    ('float32[2, 3]', '0.5')
    """
    return f"{value.dtype}{[*value.shape]}" if hasattr(value, "dtype") else f"{value!r:.60}"
