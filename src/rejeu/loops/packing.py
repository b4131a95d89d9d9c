"""Many small arrays side by side in a few vectors, for the way into compiled code and back.

Each array that crosses the border between Python and XLA costs between one and four microseconds, whatever its size, and
several times that when an environment has just emptied the processor's caches. A state of SAC has some fifty arrays, a
batch with its clock some ten; packed, they are four: a state three (:class:`Packing`), what the host sends one
(:class:`Message`). Inside the compiled code they are slices again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Hashable, Iterator, Mapping
from typing import Any, NamedTuple

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


class Part(NamedTuple):
    """What a message sends in one piece: a leaf, or the whole of an array of records of which leaves are fields."""

    leaves: tuple[int, ...]
    """Positions of the leaves that are in it."""
    offsets: tuple[int, ...] | None
    """The words before each of them in a record; None for a leaf that is sent by itself."""
    dtype: Any
    """Of its words; None if it is not made of words."""
    shape: tuple[int, ...]
    """Its words; of records ``(rows, words of one)``."""


class Message:
    """How the leaves of one kind of tree of NumPy arrays travel into compiled code: side by side in one vector of words.

    A word is four bytes, of a float or of anything else: the vector is called ``float32``, and what is not is taken for what
    it is again inside, bit for bit. Dtypes are JAX's (64 bits become 32); narrower ones are widened on the way. Leaves that
    are fields of one array of records are sent as those records, whole: copying one block is several times faster than
    picking fields out of it. What has more than ``LARGE`` words, or dtypes of another width, travels by itself. Immutable,
    and equal only to itself, so that a compiled function may take it as a static argument.
    """

    def __init__(self, tree: PyTree, by_records: bool = True) -> None:
        """Plans for trees of the structure, shapes and dtypes of ``tree``, whose leaves have ``shape`` and ``dtype``.

        With ``by_records=False`` every leaf is sent by itself, whether or not it is a field of records.
        """
        leaves, self.structure = jax.tree.flatten(tree)
        self.shapes: list[tuple[int, ...]] = [tuple(leaf.shape) for leaf in leaves]
        self.dtypes: list[Any] = [jax.dtypes.canonicalize_dtype(leaf.dtype) for leaf in leaves]
        self.together = parts_of_records(leaves) if by_records else []
        in_records = {i for part in self.together for i in part.leaves}
        parts = self.together + [self._alone(i) for i in range(len(leaves)) if i not in in_records]
        self.small = [part for part in parts if part.dtype is not None and math.prod(part.shape) <= LARGE]
        self.large = [part for part in parts if part not in self.small]
        self.ends = np.cumsum([math.prod(part.shape) for part in self.small]).tolist()
        self.record = np.dtype([(str(k), part.dtype, part.shape) for k, part in enumerate(self.small)])
        """The vector as NumPy fills it: every part a field."""
        self.fields = list(zip(self.record.names or (), self.small, strict=True))

    def _alone(self, i: int) -> Part:
        dtype = self.dtypes[i]
        return Part((i,), None, WORDS.get(dtype.kind) if dtype.itemsize <= 4 else None, self.shapes[i])

    def fits(self, leaves: list[Any]) -> bool:
        """Returns whether leaves that were fields of records as the plan was made still are fields of the same ones."""
        for part in self.together:
            first, *others = part.leaves
            records = getattr(leaves[first], "base", None)
            if records is None or records.nbytes != 4 * math.prod(part.shape):
                return False
            for i in others:
                if getattr(leaves[i], "base", None) is not records:
                    return False
        return True

    def pack(self, leaves: list[Any]) -> list[np.ndarray]:
        """Returns the vector of the leaves of a tree, which is a copy, and then what travels by itself."""
        record = np.empty(1, self.record)
        for name, part in self.fields:
            record[name] = sent(part, leaves)
        vector = record.view(np.float32) if self.record.itemsize else np.zeros(0, np.float32)
        return [vector, *[sent(part, leaves) for part in self.large]]

    def unpack(self, arrays: list[Any]) -> PyTree:
        """Returns the tree again, inside compiled code."""
        leaves: list[Any] = [None] * len(self.shapes)
        for part, begin, end in zip(self.small, [0, *self.ends], self.ends, strict=False):
            words = arrays[0][begin:end].reshape(part.shape)
            if part.offsets is None:
                leaves[part.leaves[0]] = as_dtype(words, self.dtypes[part.leaves[0]])
            else:
                self._take_apart(part, words, leaves)
        for part, array in zip(self.large, arrays[1:], strict=True):
            if part.offsets is None:
                leaves[part.leaves[0]] = array
            else:
                self._take_apart(part, array, leaves)
        return jax.tree.unflatten(self.structure, leaves)

    def _take_apart(self, part: Part, records: Array, leaves: list[Any]) -> None:
        """Puts the fields of records, which have arrived as their words, where they belong among the leaves."""
        assert part.offsets is not None
        for i, offset in zip(part.leaves, part.offsets, strict=True):
            width = math.prod(self.shapes[i]) // part.shape[0]
            leaves[i] = as_dtype(records[:, offset : offset + width].reshape(self.shapes[i]), self.dtypes[i])


def sent(part: Part, leaves: list[Any]) -> Any:
    """Returns what stands for a part among the leaves of a tree: the leaf, or the words of its records."""
    leaf = leaves[part.leaves[0]]
    return leaf if part.offsets is None else leaf.base.view(np.float32).reshape(part.shape)


def as_dtype(words: Array, dtype: Any) -> Array:
    """Returns words, called ``float32``, as what they are, inside compiled code."""
    if dtype.kind != "f":
        words = jax.lax.bitcast_convert_type(words, WORDS[dtype.kind])
    return words.astype(dtype)


def parts_of_records(leaves: list[Any]) -> list[Part]:
    """Returns the arrays of records that are better sent whole: those of whose words the leaves are half or more."""
    found: dict[int, list[tuple[int, int]]] = {}
    for i, leaf in enumerate(leaves):
        offset = offset_in_records(leaf)
        if offset is not None:
            found.setdefault(id(leaf.base), []).append((i, offset))
    parts = []
    for members in found.values():
        positions, offsets = zip(*members, strict=True)
        records = leaves[positions[0]].base
        if 2 * sum(leaves[i].nbytes for i in positions) >= records.nbytes:
            parts.append(Part(positions, offsets, np.float32, (records.size, records.itemsize // 4)))
    return parts


def offset_in_records(leaf: Any) -> int | None:
    """Returns how many words precede a leaf in each record, if it is a field, all rows in order, of records of words.

    Rows may have been given a shape of several axes since. None for any other array.
    """
    records = getattr(leaf, "base", None)
    if not isinstance(records, np.ndarray) or records.dtype.names is None or records.ndim != 1 or not leaf.size:
        return None
    words = leaf.dtype.itemsize == 4 and records.itemsize % 4 == 0 and records.flags.c_contiguous
    if not words or leaf.size % records.size:
        return None
    rows = leaf.reshape(records.size, -1)
    if rows.base is not records or rows.strides[0] != records.itemsize or (rows.shape[1] > 1 and rows.strides[1] != 4):
        return None
    before = rows.__array_interface__["data"][0] - records.__array_interface__["data"][0]
    return None if before % 4 else before // 4


class HostPacker:
    """Packs trees of NumPy arrays into messages, planning once for each size of tree that it meets."""

    def __init__(self) -> None:
        self._plans: dict[Any, Message] = {}

    def __call__(self, tree: PyTree, size: Hashable) -> tuple[list[np.ndarray], Message]:
        """Returns the arrays that hold ``tree`` and the plan to unpack them by.

        Trees of one ``size`` must have the same structure, shapes and dtypes, and leaves that are fields of records must be
        the same fields, unless they are copies: comparing all that takes longer than packing.
        """
        leaves = jax.tree.leaves(tree)
        plan = self._plans.get(size)
        if plan is None:
            plan = self._plans[size] = Message(tree)
        if not plan.fits(leaves):
            plan = self._plans.get((HostPacker, size))
            if plan is None:
                plan = self._plans[HostPacker, size] = Message(tree, by_records=False)
        return plan.pack(leaves), plan
