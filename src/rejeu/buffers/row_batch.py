"""Batches as the rows of the ring that they were read from, for compiled functions.

A compiled function takes two to four microseconds for each NumPy array that it is given. A batch of observations with goals
has nine, most of which are side by side in the rows of a ring. Sent as rows, which compiled code takes apart, it has three,
and a whole step of SAC with hindsight and several environments is 6 % faster. Batches of a single observation array have
five; with them it makes no difference, and they are sent as they are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial
from operator import is_
from typing import Any

import jax
import numpy as np
from jax import Array

from rejeu import xla
from rejeu.core import PyTree, Transition


class Layout:
    """Where the fields of a row are, in words of four bytes. Equal only to itself; static in compiled functions."""

    def __init__(self, record: np.dtype, n_leaves: int, obs_structure: Any) -> None:
        """Takes the dtype of rows, and the number and the structure of the arrays of an observation."""
        assert record.fields is not None
        self.fields = {name: (field[0], field[1] // 4) for name, field in record.fields.items()}
        self.n_leaves, self.obs_structure = n_leaves, obs_structure
        self.words = np.dtype((np.float32, (record.itemsize // 4,)))
        """A row as words, all of them called floating-point numbers on the way."""

    def field(self, words: Array, name: str) -> Array:
        """Returns a field of ``words``, ``(..., words of a row)``; used inside compiled code."""
        dtype, begin = self.fields[name]
        found = words[..., begin : begin + math.prod(dtype.shape)]
        if dtype.base != np.float32:
            found = jax.lax.bitcast_convert_type(found, dtype.base)
        return found.reshape(words.shape[:-1] + dtype.shape)

    def obs(self, words: Array) -> PyTree:
        """Returns the observations in ``words``; used inside compiled code."""
        return jax.tree.unflatten(self.obs_structure, [self.field(words, f"obs.{i}") for i in range(self.n_leaves)])


@cache
def layout_of(record: np.dtype, n_leaves: int, obs_structure: Any) -> Layout | None:
    """Returns the layout of rows; None if they are not worth sending, or not all of their numbers have four bytes."""
    fields: Any = record.fields or {}
    has_words = all(dtype.base.itemsize == 4 for dtype, *_ in fields.values())
    has_obs = all(f"obs.{i}" in fields for i in range(n_leaves))
    return Layout(record, n_leaves, obs_structure) if n_leaves > 1 and has_words and has_obs else None


@partial(
    jax.tree_util.register_dataclass,
    data_fields=("step", "following", "reward", "discount", "weight", "rewards"),
    meta_fields=("layout",),
)
class RowBatch:
    """A batch for compiled functions, read from rows of this layout."""

    def __init__(
        self, step: Any, following: Any, reward: Any, discount: Any, weight: Any, rewards: Any, layout: Layout
    ) -> None:
        """Takes the words of the rows of the steps, and of the rows after them; the rest as in :class:`Transition`.

        ``reward`` is None if that of the rows is meant.
        """
        self.step, self.following, self.layout = step, following, layout
        self.reward, self.discount, self.weight, self.rewards = reward, discount, weight, rewards

    def transition(self) -> Transition:
        """Returns the batch taken apart; used inside compiled code."""
        field, obs = self.layout.field, self.layout.obs
        reward = field(self.step, "reward") if self.reward is None else self.reward
        action, next_obs = field(self.step, "action"), obs(self.following)
        return Transition(obs(self.step), action, reward, next_obs, self.discount, self.weight, self.rewards)


class RowTransition(Transition):
    """A batch with the rows of which its arrays are views."""

    rows: RowBatch | None = None
    """The same batch for compiled functions; None in copies, such as those of ``_replace``."""
    leaves: list[Any]
    """Its arrays when it was read."""


def with_rows(batch: RowTransition, step: np.ndarray, following: np.ndarray, layout: Layout) -> RowTransition:
    """Returns ``batch``, which is mutated, with its rows: the flat records of its steps, and of those after them."""
    step_words, next_words = (row.view(layout.words).reshape(*batch.discount.shape, -1) for row in (step, following))
    reward = None if batch.reward.base is step else batch.reward
    batch.rows = RowBatch(step_words, next_words, reward, batch.discount, batch.weight, batch.rewards, layout)
    batch.leaves = jax.tree.leaves(batch)
    return batch


def rows_of(batches: Any) -> Any:
    """Returns the rows of a batch, or the batch itself if it has none or one of its arrays was replaced."""
    if not isinstance(batches, RowTransition) or batches.rows is None:
        return batches
    return batches.rows if all(map(is_, jax.tree.leaves(batches), batches.leaves)) else batches


def jit_update(update: Callable[..., Any]) -> Callable[..., Any]:
    """Returns ``update(state, batches, clock)`` compiled, to which batches are sent as rows; the state is donated."""

    @partial(jax.jit, donate_argnums=0)
    def compiled(state: Any, batches: Any, clock: Any) -> Any:
        is_rows = isinstance(batches, RowBatch)
        return update(state, xla.one_kernel(RowBatch.transition)(batches) if is_rows else batches, clock)

    return lambda state, batches, clock: compiled(state, rows_of(batches), clock)
