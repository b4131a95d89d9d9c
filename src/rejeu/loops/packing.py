"""The state of an algorithm as a few vectors, and metrics as one.

Each array that enters or leaves a compiled function costs about a microsecond. The state of SAC has some fifty, and as a
tree of modules Python must flatten it as well. Packed by dtype into three vectors it makes a whole step 6 to 12 % faster;
see ``docs/performance.md``. Inside compiled code the arrays are slices of the vectors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rejeu.core import PyTree

LARGE = 2**13
"""Number of elements above which an array is not packed, because copying it costs more than it saves."""
PackedState = list[Array]
"""The vectors of a :class:`Packing`."""


class Packing:
    """How trees of one structure are packed: arrays of equal dtype into one vector, large ones as they are. Immutable."""

    def __init__(self, tree: PyTree) -> None:
        """Plans for trees of the structure, shapes and dtypes of ``tree``, whose leaves have ``shape`` and ``dtype``."""
        leaves, self.structure = jax.tree.flatten(tree)
        self.shapes: list[tuple[int, ...]] = [tuple(leaf.shape) for leaf in leaves]
        self.sizes = [math.prod(shape) for shape in self.shapes]
        small: dict[Any, list[int]] = {}
        for i, leaf in enumerate(leaves):
            if self.sizes[i] <= LARGE:
                small.setdefault(np.dtype(leaf.dtype), []).append(i)
        self.groups = list(small.values())
        """Indices of the leaves that share a vector, by vector."""
        self.large = [i for i, size in enumerate(self.sizes) if size > LARGE]
        self.longest = max((sum(self.sizes[i] for i in group) for group in self.groups), default=0)
        """Number of elements of the longest vector."""

    def pack(self, tree: PyTree, concatenate: Callable[..., Any] = jnp.concatenate) -> list[Any]:
        """Returns the vectors of ``tree`` and then its large leaves; with ``np.concatenate`` of NumPy arrays."""
        leaves = jax.tree.leaves(tree)
        vectors = [concatenate([leaves[i].reshape(-1) for i in group]) for group in self.groups]
        return vectors + [leaves[i] for i in self.large]

    def unpack(self, arrays: list[Any]) -> PyTree:
        """Returns the tree that was packed: the inverse of :meth:`pack`."""
        leaves: list[Any] = [None] * len(self.shapes)
        for vector, group in zip(arrays, self.groups, strict=False):
            end = 0
            for i in group:
                begin, end = end, end + self.sizes[i]
                leaves[i] = vector[begin:end].reshape(self.shapes[i])
        for i, array in zip(self.large, arrays[len(self.groups) :], strict=True):
            leaves[i] = array
        return jax.tree.unflatten(self.structure, leaves)


@partial(jax.tree_util.register_dataclass, data_fields=("vector",), meta_fields=("names",))
@dataclass(frozen=True, eq=False)
class Readings(Mapping[str, Array]):
    """The metrics of an update: named scalars in one vector on the device. Reading one waits for it."""

    names: tuple[str, ...]
    vector: Array
    """Its last element has no name: the number of gradient steps that left NaN or infinity."""

    @classmethod
    def of(cls, scalars: Mapping[str, Array], n_bad: Array | int = 0) -> Readings:
        """Packs scalars and the number of bad gradient steps, inside compiled code."""
        return cls(tuple(scalars), jnp.stack([*scalars.values(), jnp.asarray(n_bad, jnp.float32)]))

    @property
    def n_bad(self) -> int:
        """The number of gradient steps that left NaN or infinity; waits for the device."""
        return int(np.asarray(self.vector)[-1])

    def __getitem__(self, name: str) -> Array:
        if name not in self.names:
            raise KeyError(name)
        return self.vector[self.names.index(name)]

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)
