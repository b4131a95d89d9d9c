"""Networks with memory: a recurrent cell between the encoder and the hidden layers.

Cells: LSTM (Hochreiter and Schmidhuber 1997, with the forget gate of Gers et al. 2000) and GRU (Cho et al. 2014, arXiv
1406.1078), in the form of PyTorch's documentation.

Networks that learn from replay see their observations as :class:`rejeu.core.algorithm.Sequences`, and unroll the cell over
them from the memory that was stored when they acted (Kapturowski et al. 2019, "Recurrent Experience Replay in Distributed
Reinforcement Learning", R2D2). All losses stay as they are, since what a network returns has one row for each transition.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from rejeu.core.algorithm import PyTree, Remembered, Sequences, renew, unmasked
from rejeu.core.spaces import Leaf
from rejeu.core.validation import choice, coerce, whole
from rejeu.networks.encoder import make_encoder
from rejeu.networks.shape import PolicyConfig


@dataclass(frozen=True)
class MemoryConfig(PolicyConfig):
    """The shape of networks that learn from replay, which may have a memory."""

    lstm_hidden_size: int | None = None
    """Size of the memory of the networks, a recurrent cell before their hidden layers, for observations that do not show
    the whole state. The replay buffer stores it with every step. None: no memory."""
    cell: Literal["lstm", "gru"] = "lstm"
    """The recurrent cell."""
    sequence_length: int = 16
    """With memory: successive steps that are learned from together, over which gradients are propagated. Divides
    ``batch_size``. A larger value learns dependencies over more steps, from fewer sequences."""
    burn_in: int = 8
    """With memory: steps before a sequence over which the stored memory is computed again with the present weights, without
    gradient (R2D2). A larger value corrects older memories better, at a higher cost."""

    def __post_init__(self) -> None:
        PolicyConfig.__post_init__(self)
        coerce(self, "lstm_hidden_size", whole, least=1, optional=True)
        coerce(self, "cell", choice, among=("lstm", "gru"))
        coerce(self, "sequence_length", whole, least=1)
        coerce(self, "burn_in", whole, least=0)


class Cell(eqx.Module):
    """A recurrent cell: an LSTM or a GRU."""

    inputs: Array
    """``(n_inputs, n_gates * size)``."""
    recurrent: Array
    """``(size, n_gates * size)``."""
    bias: Array
    """``(n_gates * size,)``."""
    recurrent_bias: Array
    """``(n_gates * size,)``."""
    kind: str = eqx.field(static=True)

    def __init__(self, key: Array, n_inputs: int, size: int, cell_type: str) -> None:
        """Draws everything uniformly within ``1 / sqrt(size)`` of 0, PyTorch's default."""
        width = (4 if cell_type == "lstm" else 3) * size
        bound = 1.0 / math.sqrt(size)
        shapes = ((n_inputs, width), (size, width), (width,), (width,))
        pairs = zip(jax.random.split(key, 4), shapes, strict=True)
        drawn = [jax.random.uniform(k, shape, jnp.float32, -bound, bound) for k, shape in pairs]
        self.inputs, self.recurrent, self.bias, self.recurrent_bias = drawn
        self.kind = cell_type

    @property
    def size(self) -> int:
        """Numbers that come out."""
        return self.recurrent.shape[0]

    def empty(self, n: int) -> tuple[Array, ...]:
        """Returns the memory at the start of ``n`` episodes, ``(n, size)`` each."""
        return tuple(jnp.zeros((n, self.size), jnp.float32) for _ in range(2 if self.kind == "lstm" else 1))

    def project(self, x: Array) -> Array:
        """Returns the contribution of the inputs ``(..., n_inputs)`` to the gates; of many steps at once."""
        return x @ self.inputs + self.bias.reshape(*[1] * (x.ndim - 1), -1)

    def step(self, memory: tuple[Array, ...], projected: Array) -> tuple[Array, ...]:
        """Returns the memory after one step, ``(n, size)`` each; the first of it is what comes out."""
        recurrent = memory[0] @ self.recurrent + self.recurrent_bias[None]
        if self.kind == "lstm":
            i, f, g, o = jnp.split(projected + recurrent, 4, axis=-1)
            cell = jax.nn.sigmoid(f) * memory[1] + jax.nn.sigmoid(i) * jnp.tanh(g)
            return jax.nn.sigmoid(o) * jnp.tanh(cell), cell
        reset, update, new = jnp.split(projected, 3, axis=-1)
        r, z, n = jnp.split(recurrent, 3, axis=-1)
        keep = jax.nn.sigmoid(update + z)
        return ((1.0 - keep) * jnp.tanh(new + jax.nn.sigmoid(reset + r) * n) + keep * memory[0],)

    def unroll(
        self, memory: tuple[Array, ...], x: Array, begins: Array, absent: Array | None = None
    ) -> tuple[Array, ...]:
        """Returns the memory after each of many steps, ``(steps, n, size)`` each.

        Args:
            memory: before the first step, ``(n, size)`` each.
            x: the inputs, ``(steps, n, n_inputs)``.
            begins: where an episode begins with a step, before which the memory is emptied, ``bool (steps, n)``.
            absent: where there is no step, likewise; the memory is then kept. None: nowhere.
        """

        def step(before: tuple[Array, ...], inputs: PyTree) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
            projected, begins, absent = inputs
            after = self.step(renew(begins, self.empty(begins.shape[0]), before), projected)
            after = after if absent is None else renew(absent, before, after)
            return after, after

        return jax.lax.scan(step, memory, (self.project(x), begins, absent))[1]


class Recurrent(eqx.Module):
    """A network, or several stacked, that reads what a cell remembers of the observations of the episode so far."""

    encoder: PyTree
    cell: Cell
    reader: PyTree
    """Maps what is remembered, ``(batch, size)``; stacked networks share the memory."""
    slot: int = eqx.field(static=True)
    """Which part of the memory of all networks is that of this one."""
    burn_in: int = eqx.field(static=True)

    def __call__(self, obs: PyTree, *inputs: Array) -> Array:
        """Returns the outputs of the network for observations and other inputs, ``(batch, ...)`` each."""
        return self.reader(self.remembered(obs), *inputs)

    @property
    def n_numbers(self) -> int:
        """Size of its part of the memory."""
        return self.cell.size * len(self.cell.empty(0))

    def part(self, memory: Array) -> tuple[Array, ...]:
        """Returns its part of the memory of all networks ``(n, n_numbers)``, ``(n, size)`` each."""
        columns = memory[:, self.slot * self.n_numbers : (self.slot + 1) * self.n_numbers]
        return tuple(jnp.split(columns, self.n_numbers // self.cell.size, axis=1))

    def after(self, memory: Array, obs: PyTree) -> Array:
        """Returns its part of the memory after observations ``(n, ...)``, from the memory of all networks before them."""
        return jnp.concatenate(self.cell.step(self.part(memory), self.cell.project(self.encoder(obs))), axis=1)

    def remembered(self, obs: PyTree) -> Array:
        """Returns the output of the cell for observations, ``(batch, size)``; plain ones are the first of their episodes."""
        obs, _ = unmasked(obs)
        if isinstance(obs, Remembered):
            return self.part(obs.memory)[0]
        if isinstance(obs, Sequences):
            return self.unrolled(obs)
        features = self.encoder(obs)
        return self.cell.step(self.cell.empty(features.shape[0]), self.cell.project(features))[0]

    def unrolled(self, sequences: Sequences) -> Array:
        """Returns the outputs of the cell at the rows that are read, ``(sequences * n_reads, size)``."""
        memory, burn_in = self.part(sequences.memory), self.burn_in

        def unroll(
            network: Recurrent, memory: tuple[Array, ...], window: slice, absent: Array | None = None
        ) -> tuple[Array, ...]:
            rows = jax.tree.map(lambda x: jnp.swapaxes(x[:, window], 0, 1), (sequences.obs, sequences.begins))
            obs, begins = rows
            flat = jax.tree.map(lambda x: x.reshape(begins.size, *x.shape[2:]), obs)
            features = network.encoder(flat).reshape(*begins.shape, -1)
            return network.cell.unroll(memory, features, begins, absent)

        if burn_in:
            absent = jnp.arange(burn_in)[:, None] < sequences.n_absent[None]
            memory = tuple(x[-1] for x in unroll(jax.lax.stop_gradient(self), memory, slice(burn_in), absent))
        after = jnp.swapaxes(unroll(self, memory, slice(burn_in, None))[0], 0, 1)
        read = jnp.take_along_axis(after, (sequences.reads - burn_in)[..., None], axis=1)
        return read.reshape(-1, self.cell.size)


def with_memory(
    key: Array,
    leaves: tuple[Leaf, ...],
    shape: Any,
    make: Callable[[tuple[Leaf, ...], PyTree], PyTree],
    slot: int = 0,
) -> PyTree:
    """Returns the networks ``make(leaves, shape)``; with a memory, they read what a cell remembers of the observations.

    ``slot`` numbers the memories of an algorithm, those of its actor, of all its critics, and so on.
    """
    if shape.lstm_hidden_size is None:
        return make(leaves, shape)
    encoder_key, cell_key = jax.random.split(jax.random.fold_in(key, 3))
    encoder = make_encoder(encoder_key, leaves, shape)
    cell = Cell(cell_key, encoder.n_features, shape.lstm_hidden_size, shape.cell)
    remembered = Leaf("", "continuous", (cell.size,), "float32")
    return Recurrent(encoder, cell, make((remembered,), dataclasses.replace(shape, encoder=None)), slot, shape.burn_in)


def each(critics: PyTree, obs: PyTree, call: Callable[[PyTree, PyTree], Array]) -> Array:
    """Returns ``call(critic, obs)`` of each of the stacked critics, ``(n_critics, ...)``, which may share a memory."""
    if isinstance(critics, Recurrent):
        critics, obs = critics.reader, critics.remembered(obs)
    return jax.vmap(lambda critic: call(critic, obs))(critics)


def some(critics: PyTree, index: ArrayLike) -> PyTree:
    """Returns those of stacked critics that ``index`` names: the numbers of several, or of one without the leading axis."""
    reader = jax.tree.map(lambda leaf: leaf[index], critics.reader if isinstance(critics, Recurrent) else critics)
    return dataclasses.replace(critics, reader=reader) if isinstance(critics, Recurrent) else reader


def first(critics: PyTree) -> PyTree:
    """Returns the first of stacked critics."""
    return some(critics, 0)
