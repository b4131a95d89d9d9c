"""Minibatches of a rollout: every step once in each epoch, in random order."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

D = TypeVar("D")


def minibatches(data: D, key: Array, n_epochs: int, batch_size: int) -> tuple[Callable[[Array], D], Array]:
    """Returns the minibatches of all epochs as a function of their number, and how many there are, ``int32[]``.

    Args:
        data: the steps of a rollout, a NamedTuple of leaves ``(n, ...)`` with a field ``valid``, which says which steps
            there are. A minibatch has the same fields; those that it lacks of ``batch_size`` are not valid in it.
        key: of the random order.
        n_epochs: passes over all steps.
        batch_size: steps of a minibatch; fewer if the rollout has fewer.
    """
    steps: Any = data
    n = steps.valid.shape[0]
    size = min(batch_size, n)
    n_valid = jnp.sum(steps.valid)
    n_batches = (n_valid + size - 1) // size
    orders = shuffled(key, steps.valid, n_epochs, -n % size)

    def minibatch(i: Array) -> D:
        first = (i % n_batches) * size
        index = jax.lax.dynamic_slice(orders, (i // n_batches, first), (1, size))[0]
        chosen = jax.tree.map(lambda x: x[index], steps)
        return chosen._replace(valid=first + jnp.arange(size) < n_valid)

    return minibatch, n_epochs * n_batches


def shuffled(key: Array, valid: Array, n_epochs: int, n_padding: int) -> Array:
    """Returns a random order of all steps for every epoch, the valid ones first, ``int32 (n_epochs, n + padding)``."""
    drawn = jax.random.uniform(key, (n_epochs, valid.shape[0])) + jnp.where(valid, 0.0, 2.0)[None]
    return jnp.pad(jnp.argsort(drawn, axis=1).astype(jnp.int32), ((0, 0), (0, n_padding)))
