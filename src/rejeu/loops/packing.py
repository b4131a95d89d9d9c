"""Many small arrays side by side in a few vectors, for the way into compiled code and back.

Each array that crosses the border between Python and XLA costs between one and four microseconds, whatever its size, and
several times that when an environment has just emptied the processor's caches. A state of SAC has some fifty arrays, a
batch with its clock some ten; packed, they are four: a state three (:class:`Packing`), what the host sends one
(:class:`Message`). Inside the compiled code they are slices again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Hashable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rejeu.core import PyTree

LARGE = 2**13
"""Number of elements above which an array stays by itself: copying it would cost more than it saves."""
WORDS = {"f": np.float32, "i": np.int32, "u": np.uint32, "b": np.uint32}
"""What four bytes of a message are, by kind of dtype."""


class Packing:
    """How the leaves of one kind of tree are packed: by dtype into one vector each, large ones left as they are.

    Immutable, and equal only to itself, so that a compiled function may take it as a static argument.
    """

    def __init__(self, tree: PyTree) -> None:
        """Plans for trees of the structure, shapes and dtypes of ``tree``, whose leaves have ``shape`` and ``dtype``."""
        leaves, self.structure = jax.tree.flatten(tree)
        self.shapes: list[tuple[int, ...]] = [tuple(leaf.shape) for leaf in leaves]
        sizes = [math.prod(shape) for shape in self.shapes]
        small: dict[Any, list[int]] = {}
        for i, leaf in enumerate(leaves):
            if sizes[i] <= LARGE:
                small.setdefault(np.dtype(leaf.dtype), []).append(i)
        self.groups = list(small.values())
        """Positions of the leaves that share a vector, by vector."""
        self.ends = [np.cumsum([sizes[i] for i in group]).tolist() for group in self.groups]
        self.large = [i for i, size in enumerate(sizes) if size > LARGE]

    def pack(self, tree: PyTree) -> list[Array]:
        """Returns the vectors of ``tree`` and then its large leaves, inside compiled code."""
        return self._pack(jax.tree.leaves(tree), jnp.concatenate)

    def pack_leaves(self, leaves: list[np.ndarray]) -> list[np.ndarray]:
        """Returns the same of the leaves of a tree on the host; the vectors are copies."""
        return self._pack(leaves, np.concatenate)

    def _pack(self, leaves: list[Any], concatenate: Callable[..., Any]) -> list[Any]:
        vectors = [concatenate([leaves[i].reshape(-1) for i in group]) for group in self.groups]
        return vectors + [leaves[i] for i in self.large]

    def without(self, arrays: list[Array], unwanted: Container[int]) -> list[Array]:
        """Returns :meth:`pack`'s arrays without the large ones among the ``unwanted`` leaves."""
        large = zip(self.large, arrays[len(self.groups) :], strict=True)
        return arrays[: len(self.groups)] + [array for i, array in large if i not in unwanted]

    def unpack(self, arrays: list[Any]) -> PyTree:
        """Returns the tree again: the inverse of :meth:`pack`."""
        leaves: list[Any] = [None] * len(self.shapes)
        for vector, group, ends in zip(arrays, self.groups, self.ends, strict=False):
            for i, begin, end in zip(group, [0, *ends], ends, strict=False):
                leaves[i] = vector[begin:end].reshape(self.shapes[i])
        for i, array in zip(self.large, arrays[len(self.groups) :], strict=True):
            leaves[i] = array
        return jax.tree.unflatten(self.structure, leaves)


@jax.tree_util.register_pytree_node_class
class Readings(Mapping[str, Array]):
    """Named scalars that are on the device as one vector; reading one waits for it.

    Its last element has no name: of how many of its steps the update left numbers that are not finite.
    """

    def __init__(self, names: tuple[str, ...], vector: Array) -> None:
        self.names = names
        self.vector = vector

    @classmethod
    def of(cls, scalars: Mapping[str, Array], n_bad: Array | int = 0) -> Readings:
        """Packs scalars and the number of steps that left something not finite, inside compiled code."""
        return cls(tuple(scalars), jnp.stack([*scalars.values(), jnp.asarray(n_bad, jnp.float32)]))

    @property
    def n_bad(self) -> int:
        """How many of its steps broke something (one that did breaks those after it, unless it is skipped)."""
        return int(np.asarray(self.vector)[-1])

    def __getitem__(self, name: str) -> Array:
        if name not in self.names:
            raise KeyError(name)
        return self.vector[self.names.index(name)]

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def tree_flatten(self) -> tuple[tuple[Array], tuple[str, ...]]:
        return (self.vector,), self.names

    @classmethod
    def tree_unflatten(cls, names: tuple[str, ...], children: tuple[Array]) -> Readings:
        return cls(names, *children)


class Message:
    """How the leaves of one kind of tree of NumPy arrays travel into compiled code: side by side in one vector of words.

    A word is four bytes, of a float or of anything else: the vector is called ``float32``, and what is not is taken for what
    it is again inside, bit for bit. Dtypes are JAX's (64 bits become 32); narrower ones are widened on the way. Leaves of
    more than ``LARGE`` elements, and of dtypes of another width, travel by themselves. Immutable, and equal only to itself,
    so that a compiled function may take it as a static argument.
    """

    def __init__(self, tree: PyTree) -> None:
        """Plans for trees of the structure, shapes and dtypes of ``tree``, whose leaves have ``shape`` and ``dtype``."""
        leaves, self.structure = jax.tree.flatten(tree)
        self.shapes: list[tuple[int, ...]] = [tuple(leaf.shape) for leaf in leaves]
        self.dtypes: list[Any] = [jax.dtypes.canonicalize_dtype(leaf.dtype) for leaf in leaves]
        sizes = [math.prod(shape) for shape in self.shapes]
        words = [WORDS.get(dtype.kind) if dtype.itemsize <= 4 else None for dtype in self.dtypes]
        self.small = [i for i, size in enumerate(sizes) if size <= LARGE and words[i] is not None]
        self.large = [i for i in range(len(leaves)) if i not in self.small]
        self.ends = np.cumsum([sizes[i] for i in self.small]).tolist()
        self.record = np.dtype([(str(i), words[i], self.shapes[i]) for i in self.small])
        """The vector as NumPy fills it: every leaf a field."""
        self.fields = list(zip(self.record.names or (), self.small, strict=True))

    def pack(self, tree: PyTree) -> list[np.ndarray]:
        """Returns the vector of ``tree``, which is a copy, and then the leaves that travel by themselves."""
        leaves = jax.tree.leaves(tree)
        record = np.empty(1, self.record)
        for name, i in self.fields:
            record[name] = leaves[i]
        vector = record.view(np.float32) if self.record.itemsize else np.zeros(0, np.float32)
        return [vector, *[leaves[i] for i in self.large]]

    def unpack(self, arrays: list[Any]) -> PyTree:
        """Returns the tree again, inside compiled code."""
        leaves: list[Any] = [None] * len(self.shapes)
        for i, begin, end in zip(self.small, [0, *self.ends], self.ends, strict=False):
            words, dtype = arrays[0][begin:end].reshape(self.shapes[i]), self.dtypes[i]
            if dtype.kind != "f":
                words = jax.lax.bitcast_convert_type(words, WORDS[dtype.kind])
            leaves[i] = words.astype(dtype)
        for i, array in zip(self.large, arrays[1:], strict=True):
            leaves[i] = array
        return jax.tree.unflatten(self.structure, leaves)


class HostPacker:
    """Packs trees of NumPy arrays into messages, planning once for each size of tree that it meets."""

    def __init__(self) -> None:
        self._plans: dict[Any, Message] = {}

    def __call__(self, tree: PyTree, size: Hashable) -> tuple[list[np.ndarray], Message]:
        """Returns the arrays that hold ``tree`` and the plan to unpack them by.

        Trees of one ``size`` must have the same structure, shapes and dtypes: comparing them takes longer than packing.
        """
        plan = self._plans.get(size)
        if plan is None:
            plan = self._plans[size] = Message(tree)
        return plan.pack(tree), plan
