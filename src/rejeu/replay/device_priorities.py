"""Prioritized replay on the device: :class:`rejeu.replay.prioritized.Priorities` as arrays and pure functions.

The sum tree has three levels: the priorities, their sums in blocks of ``WIDTH``, and the sums of these. A change of some
priorities computes the sums of their blocks again, so it does not matter in which order several are changed. With few
levels, few programs run on the device, each on many numbers.

For equal random numbers the steps and weights are those of the host, up to the rounding of sums: priorities have 32 bits
here, 64 on the host.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rejeu.core.types import AnyArray
from rejeu.replay.prioritized import Draw, Priorities, PriorityConfig

WIDTH = 128
"""Number of priorities in a block, and of blocks in a group."""
LEAST, MOST = np.float32(1e-30), np.float32(1e30)
"""Limits of priorities, so that none is 0 and no sum is infinite."""
NOWHERE = np.iinfo(np.int32).max
"""A position at which nothing is changed."""


class Pending(NamedTuple):
    """The newest gradient steps, which change priorities one turn later; ``(most_updates, batch_size)`` each."""

    position: Array
    """Positions of the steps of the batches, ``int32``."""
    time: Array
    """Their absolute times, ``int32``."""
    td_error: Array
    """Their absolute TD errors, ``float32``."""


class DevicePriorities(NamedTuple):
    """The priorities of all rows, and the gradient steps that are still to change them."""

    values: Array
    """The priorities by position, ``float32``, padded to whole blocks; 0 of rows that cannot be drawn."""
    sums: Array
    """The sum of each block, ``float32``, padded to whole groups."""
    n_steps: Array
    """Number of steps that can be drawn, ``int32[]``."""
    largest: Array
    """Largest priority so far, and the priority of new steps, ``float32[]``."""
    pending: Pending


def add(priorities: DevicePriorities, index: Array, following: Array) -> DevicePriorities:
    """Returns the priorities with new steps at ``index``, and none at ``following``; see :meth:`Priorities.add`.

    Both are ``int32 (n_envs,)``, ``NOWHERE`` for environments without a new step.
    """
    value = jnp.concatenate([jnp.zeros(len(following)), jnp.full(len(index), priorities.largest)])
    return changed(priorities, jnp.concatenate([following, index]), value)


def changed(priorities: DevicePriorities, index: Array, value: Array) -> DevicePriorities:
    """Returns the priorities with ``value`` ``(n,)`` at ``index`` ``(n,)``, which must differ except for ``NOWHERE``."""
    before = priorities.values.at[index].get(mode="fill", fill_value=0)
    values = priorities.values.at[index].set(value.astype(jnp.float32), mode="drop", unique_indices=True)
    block = jnp.where(index == NOWHERE, NOWHERE, index // WIDTH)
    sums = added_up(values.reshape(-1, WIDTH).at[block].get(mode="fill", fill_value=0))
    more = jnp.where(index == NOWHERE, 0, (value > 0).astype(jnp.int32) - (before > 0).astype(jnp.int32))
    return priorities._replace(
        values=values,
        sums=priorities.sums.at[block].set(sums, mode="drop"),  # of repeated blocks all sums are equal
        n_steps=priorities.n_steps + jnp.sum(more, dtype=jnp.int32),
    )


def added_up(values: AnyArray) -> AnyArray:
    """Returns the sums over the last axis, ``WIDTH`` long, in an order that does not depend on the program."""
    width = WIDTH
    while width > 1:
        width //= 2
        values = values[..., :width] + values[..., width:]
    return values[..., 0]


def draw(priorities: DevicePriorities, key: Array, n: int, beta: Array | float) -> tuple[Array, Array]:
    """Returns the positions of ``n`` steps, ``int32 (n,)``, and their importance weights; see :meth:`Priorities.draw`.

    The weights ``float32 (n,)`` are divided by the largest.
    """
    bits = jax.random.bits(jax.random.fold_in(key, 0), (n,), jnp.uint32)
    index, total = find(priorities, (bits >> 8).astype(jnp.float32) * jnp.float32(2.0**-24))
    index = index[order(key, n)]
    weight = (priorities.n_steps.astype(jnp.float32) * (priorities.values[index] / total)) ** -beta
    return index, weight / jnp.max(weight)


def order(key: Array, n: int) -> Array:
    """Returns the order in which the ``n`` steps of a batch are shuffled, for the key of its draw."""
    return jnp.argsort(jax.random.bits(jax.random.fold_in(key, 1), (n,), jnp.uint32))


def find(priorities: DevicePriorities, fraction: Array) -> tuple[Array, Array]:
    """Returns a step from each of ``n`` equal segments of the total priority, ``int32 (n,)``, and that total.

    ``fraction``, in [0, 1), says where in its segment each step is, ``float32 (n,)``.
    """
    groups = added_up(priorities.sums.reshape(-1, WIDTH))
    ends = jnp.cumsum(groups)
    segment = ends[-1] / len(fraction)
    begin, within = jnp.arange(len(fraction), dtype=jnp.float32) * segment, fraction * segment
    group, before = pick(groups[None], ends[None], begin + within)
    mass = (begin - before) + within  # in this order the sum has the digits that the segment has
    for level in (priorities.sums, priorities.values):
        row = level.reshape(-1, WIDTH)[group]
        column, before = pick(row, jnp.cumsum(row, axis=1), mass)
        group, mass = group * WIDTH + column, mass - before
    return group, ends[-1]


def pick(row: Array, ends: Array, mass: Array) -> tuple[Array, Array]:
    """Returns where the cumulative sum exceeds ``mass`` first, and the sum before that place, ``(n,)`` each.

    ``row`` and its cumulative sums ``ends`` are ``(n, width)``, or ``(1, width)`` for all. Places with 0 are never picked.
    """
    columns = jnp.arange(row.shape[1], dtype=jnp.int32)[None]
    first = jnp.min(jnp.where((row > 0) & (ends > mass[:, None]), columns, row.shape[1]), axis=1)
    last = jnp.max(jnp.where(row > 0, columns, 0), axis=1)  # the sums may round to less than mass
    column = jnp.minimum(first, last)
    before = jnp.broadcast_to(ends - row, (len(mass), row.shape[1]))
    return column, jnp.take_along_axis(before, column[:, None], axis=1)[:, 0]


def noted(pending: Pending, number: Array, position: Array, time: Array, td_error: Array) -> Pending:
    """Returns the pending priorities with those of the ``number``-th gradient step of a turn, on steps ``(batch_size,)``."""
    pairs = zip(pending, (position, time, td_error), strict=True)
    return Pending(*(rows.at[number].set(new.astype(rows.dtype)) for rows, new in pairs))


def updated(
    priorities: DevicePriorities, config: PriorityConfig, rows: int, head: Array, n_pending: Array
) -> DevicePriorities:
    """Returns the priorities after the first ``n_pending`` of the gradient steps that are pending.

    See :meth:`Priorities.update`. ``rows`` and ``head`` are those of the ring.
    """
    pending = priorities.pending
    n = pending.position.shape[1]
    later = jnp.arange(n)[None] > jnp.arange(n)[:, None]

    def one(i: Array, priorities: DevicePriorities) -> DevicePriorities:
        position = pending.position[i]
        priority = (pending.td_error[i] + jnp.float32(config.epsilon)) ** jnp.float32(config.alpha)
        finite = jnp.isfinite(priority)
        priority = jnp.where(finite, jnp.clip(priority, LEAST, MOST), LEAST)
        is_stored = pending.time[i] > head[position // rows] - rows
        is_updated = is_stored & (priorities.values[position] > 0) & finite
        again = ((position[None] == position[:, None]) & is_updated[None] & later).any(axis=1)  # the last one counts
        after = changed(priorities, jnp.where(is_updated & ~again, position, NOWHERE), priority)
        return after._replace(largest=jnp.maximum(priorities.largest, jnp.max(jnp.where(finite, priority, 0))))

    return jax.lax.fori_loop(0, n_pending, one, priorities)


def upload(
    priorities: Priorities, td_errors: Sequence[tuple[Draw, AnyArray]], most_updates: int, batch_size: int
) -> DevicePriorities:
    """Returns the priorities of the host, and the TD errors that are to change them, which must :func:`fit`."""
    ring = priorities.ring
    n = ring.rows * ring.n_envs
    n_blocks = -(-n // WIDTH)
    values, sums = np.zeros(n_blocks * WIDTH, np.float32), np.zeros(-(-n_blocks // WIDTH) * WIDTH, np.float32)
    leaves = priorities.tree[np.arange(n)]
    values[:n] = np.where(leaves > 0, np.clip(leaves, LEAST, MOST), 0)
    sums[:n_blocks] = added_up(values.reshape(-1, WIDTH))
    shape = (most_updates, batch_size)
    pending = Pending(np.zeros(shape, np.int32), np.zeros(shape, np.int32), np.zeros(shape, np.float32))  # type: ignore[arg-type]
    first = 0
    for draw, td_error in td_errors:
        size = len(draw.position)
        for array, content in zip(pending, (draw.position, draw.time, np.asarray(td_error)), strict=True):
            array.reshape(-1)[first : first + size] = content.reshape(-1)
        first += size
    largest = np.clip(np.float32(priorities.largest), LEAST, MOST)
    host = DevicePriorities(values, sums, np.int32(np.count_nonzero(values)), largest, pending)  # type: ignore[arg-type]
    return jax.tree.map(jnp.array, host)


def fit(td_errors: Sequence[tuple[Draw, AnyArray]], most_updates: int, batch_size: int) -> bool:
    """Returns whether TD errors are of whole batches, and of no more than one turn."""
    sizes = [len(draw.position) for draw, _ in td_errors]
    return all(size % batch_size == 0 for size in sizes) and sum(sizes) <= most_updates * batch_size
