"""Batches of what environments return: observations written into arrays, rewards and flags checked for shape.

The loops pay for a few comparisons here; :mod:`rejeu.envs.validation` explains what is wrong where they fail.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rejeu.envs.validation import (
    describe_value,
    leaf_name,
    leaf_spaces,
    reset_fault,
    reward_fault,
    seed_fault,
    to_array,
)
from rejeu.errors import BadEnvironmentError
from rejeu.spaces import Leaf, cast, leaves, parts


def make_writer(space: spaces.Space, stores: Sequence[np.ndarray]) -> Callable[[int, Any], None]:
    """Returns ``put(i, observation)``, which writes one observation into row ``i`` of each of the ``stores``.

    ``stores`` hold the leaves of ``space`` in the order of :func:`rejeu.spaces.leaves`, ``(n_envs, *leaf.shape)``, of the
    kept dtypes. Values of another dtype are cast if only precision is lost. ``put`` raises any exception for an invalid
    observation; :func:`rejeu.envs.validation.observation_fault` then describes what is wrong.
    """
    slots = [
        (store, leaf.shape, math.prod(leaf.shape), part.dtype, np.ndarray)
        for store, leaf, part in zip(stores, leaves(space), leaf_spaces(space), strict=True)
    ]
    if isinstance(space, spaces.Box):
        store, shape, size, dtype, array = slots[0]

        def put_array(i: int, obs: Any) -> None:
            # As many numbers as are expected can only be broadcast from shapes with leading ones, which is harmless.
            if type(obs) is not array or obs.size != size or obs.dtype is not dtype:
                obs = to_array(obs, shape, store.dtype)
            store[i] = obs

        return put_array
    if isinstance(space, spaces.Dict) and not any(
        isinstance(part, spaces.Dict | spaces.Tuple) for part in space.spaces.values()
    ):
        keyed = [(key, *slot) for key, slot in zip(sorted(space.spaces), slots, strict=True)]

        def put_dict(i: int, obs: Any) -> None:
            for key, store, shape, size, dtype, array in keyed:
                part = obs[key]
                if type(part) is not array or part.size != size or part.dtype is not dtype:
                    part = to_array(part, shape, store.dtype)
                store[i] = part

        return put_dict

    def put_parts(i: int, obs: Any) -> None:
        for (store, shape, *_), part in zip(slots, parts(space, obs), strict=True):
            store[i] = to_array(part, shape, store.dtype)

    return put_parts


def reset_env(
    env: gym.Env, seed: int | None = None, options: dict[str, Any] | None = None
) -> tuple[Any, dict[str, Any]]:
    """Resets an environment and returns the observation and the info; passes ``seed`` and ``options`` only if not None.

    Raises:
        BadEnvironmentError: if it does not accept a seed, or does not return an observation of its space and a dict.
    """
    arguments: dict[str, Any] = {} if seed is None else {"seed": seed}
    if options is not None:
        arguments["options"] = options
    try:
        answer = env.reset(**arguments)
    except TypeError as error:
        if seed is not None and (fault := seed_fault(env)) is not None:
            raise BadEnvironmentError(fault) from error
        raise
    fault = reset_fault(answer, env.observation_space)
    if fault is not None:
        raise BadEnvironmentError(fault)
    return answer


def copy_observation(space: spaces.Space, obs: Any) -> Any:
    """Returns a copy of a valid observation, in which every leaf can be cast to the declared dtype."""
    if isinstance(space, spaces.Dict):
        return {key: copy_observation(part, obs[key]) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(copy_observation(part, one) for part, one in zip(space.spaces, obs, strict=True))
    dtype = np.dtype(space.dtype)
    if isinstance(obs, np.ndarray) and np.can_cast(obs.dtype, dtype, "same_kind"):
        return obs.copy()
    return copy.deepcopy(obs) if np.isscalar(obs) else np.asarray(obs).astype(dtype)


def to_batch(space: spaces.Space, space_leaves: tuple[Leaf, ...], n_envs: int, obs: Any) -> Any:
    """Returns the observations of a vector environment, converted by :func:`rejeu.spaces.cast`.

    Raises:
        BadEnvironmentError: with the description only, if they are not ``(n_envs, *leaf.shape)`` at every leaf.
    """
    try:
        arrays = cast(space, space_leaves, obs)
    except Exception as error:  # any exception of NumPy for a value of the wrong type or shape
        raise BadEnvironmentError(
            f"observations as {describe_value(obs)}, expected a batch of {space}: {error}"
        ) from error
    for leaf, array in zip(space_leaves, parts(space, arrays), strict=True):
        if array.shape != (n_envs, *leaf.shape):
            raise BadEnvironmentError(
                f"{leaf_name(leaf.path)} of all environments of shape {array.shape}, expected {(n_envs, *leaf.shape)}; one "
                "row for each environment"
            )
    return arrays


def to_vector(name: str, values: Any, n_envs: int, dtype: Any) -> np.ndarray:
    """Returns the rewards or flags that a vector environment returned, ``dtype (n_envs,)``.

    Raises:
        BadEnvironmentError: with the description only, if they are not numbers of that shape.
    """
    array = np.asarray(values)
    if array.shape != (n_envs,) or array.dtype.kind not in ("fiub" if dtype == np.float32 else "iub"):
        kind = "numbers" if dtype == np.float32 else "bools"
        raise BadEnvironmentError(f"{name} as {describe_value(values)}, expected {kind} of shape ({n_envs},)")
    with np.errstate(over="ignore"):
        kept = array.astype(dtype, copy=False)
    if dtype == np.float32 and not math.isfinite(np.vdot(kept, kept)):
        large = array[np.isinf(kept) & np.isfinite(array)]
        if large.size:
            raise BadEnvironmentError(reward_fault(large[0].item()))
    return kept
