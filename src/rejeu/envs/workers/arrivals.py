"""Results of environments that step on their own: in which order they were taken, and those that wait to be taken."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from rejeu.envs.base import SUCCESS_KEYS, success_of
from rejeu.io.records import Count, convert
from rejeu.spaces import Leaf

INDEX = np.uint16
"""Data type of the indices of environments in a record."""


class Result(NamedTuple):
    """What an environment returned for an action, and the observation to act on next."""

    obs: list[np.ndarray]
    """Leaves of the true successor."""
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]
    begun: list[np.ndarray] | None
    """Leaves of the first observation of the next episode, None if the episode goes on."""


class SavedResult(msgspec.Struct, forbid_unknown_fields=True):
    """A result in a file. Of its info only the success is kept."""

    env: Count
    obs: list[np.ndarray]
    reward: Annotated[float, Meta(ge=-1e300, le=1e300)]
    terminated: bool
    truncated: bool
    success: Annotated[float, Meta(ge=0, le=1)] | None
    begun: list[np.ndarray] | None


def to_saved(env: int, result: Result) -> dict[str, Any]:
    """Returns a result of environment ``env`` as plain data."""
    success = success_of(result.info)
    saved = {"env": env, **result._asdict(), "success": None if np.isnan(success) else success}
    del saved["info"]
    return saved


def from_saved(saved: Any, leaves: Sequence[Leaf]) -> tuple[int, Result]:
    """Returns the index of the environment, and what :func:`to_saved` was given.

    Raises:
        CheckpointError, ValueError: if it is damaged.
    """
    one = convert(saved, SavedResult)
    for parts in (one.obs, *(() if one.begun is None else (one.begun,))):
        found = [(part.shape, part.dtype) for part in parts]
        if found != [(leaf.shape, leaf.dtype) for leaf in leaves]:
            raise ValueError(f"a result that waits has observations of {found}, not those of the environments")
        if not all(np.isfinite(part).all() for part in parts):
            raise ValueError("a result that waits is not finite")
    if (one.terminated or one.truncated) != (one.begun is not None):
        raise ValueError("a result that waits does not say where the next episode begins")
    info = {} if one.success is None else {SUCCESS_KEYS[0]: one.success}
    return one.env, Result(one.obs, one.reward, one.terminated, one.truncated, info, one.begun)


def checked_record(record: Any, n_envs: int, wait_for: int) -> np.ndarray:
    """Returns a record of arrivals, ``uint16 (turns, wait_for)``: which environments' results were taken together.

    Raises:
        ValueError: if it is not that of ``n_envs`` environments and of ``wait_for`` results at a time.
    """
    array = np.asarray(record)
    if array.ndim != 2 or array.shape[1] != wait_for or array.dtype.kind not in "iu":
        raise ValueError(
            f"arrivals is {array.dtype}{list(array.shape)}, expected whole numbers of shape (turns, wait_for={wait_for}), as "
            "the attribute arrivals of the environments holds them"
        )
    if array.size and (array.min() < 0 or array.max() >= n_envs or (np.diff(array.astype(int), axis=1) <= 0).any()):
        raise ValueError(f"arrivals must have increasing indices below n_envs={n_envs} in every row")
    return array.astype(INDEX)
