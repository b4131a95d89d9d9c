"""Hidden layers whose weights are scaled to a fixed norm after each gradient step, with batch normalization between them.

Batch normalization makes the scale of the weights before it irrelevant, but as they grow the steps of the optimizer count for
less. :func:`projected` scales them back: each unit's weights to the norm 1, and in FlashSAC the ``d`` gains of each
normalization to ``sqrt(d)``. So the effective learning rate stays the same (Palenicek et al. 2025, arXiv 2502.07523).

The normalization is :class:`rejeu.networks.batch_renorm.BatchRenorm` without renormalization. A call goes by the running
statistics; :func:`rejeu.networks.batch_renorm.in_training` goes by those of the batch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from rejeu.core.algorithm import PyTree
from rejeu.networks.batch_renorm import NEVER, BatchRenorm, RenormalizedMLP
from rejeu.networks.layers import ACTIVATIONS, RMSNorm, product

Network = TypeVar("Network")
EXPANSION = 4
"""How many times wider a block is inside."""
FINE = 1e-5
"""Number that FlashSAC adds to variances."""


class UnitLinear(eqx.Module):
    """A linear map whose units have weights of norm 1 after :func:`projected`, and a bias only as a network's head."""

    weight: Array
    """``(n_inputs, n_outputs)``."""
    bias: Array | None
    """``(n_outputs,)``."""

    def __init__(self, key: Array, n_inputs: int, n_outputs: int, bias: bool = False) -> None:
        """Draws an orthogonal matrix, its columns scaled to norm 1; the bias is 0."""
        # jaxlib's batches of QR decompositions wait for threads that other batches hold, forever if there are few (0.10.2).
        draw = jax.custom_batching.sequential_vmap(
            lambda key: jax.nn.initializers.orthogonal()(key, (n_inputs, n_outputs), jnp.float32)
        )
        self.weight = unit(draw(key), axis=0)
        self.bias = jnp.zeros((n_outputs,), jnp.float32) if bias else None

    def __call__(self, x: Array) -> Array:
        """Maps ``(batch, n_inputs)`` to ``(batch, n_outputs)``."""
        y = product(x, self.weight)
        return y if self.bias is None else y + self.bias[None]


def head(key: Array, n_inputs: int, n_outputs: int) -> UnitLinear:
    """Returns the last layer of a network."""
    return UnitLinear(key, n_inputs, n_outputs, bias=True)


class NormalizedMLP(RenormalizedMLP):
    """A normalization of the input, then layers, each a linear map, a normalization and a nonlinearity (XQC)."""

    def __init__(self, key: Array, n_inputs: int, widths: Sequence[int], activation: str) -> None:
        sizes = (n_inputs, *widths)
        keys = jax.random.split(key, max(len(widths), 1))
        self.layers = tuple(UnitLinear(k, i, o) for k, i, o in zip(keys, sizes[:-1], sizes[1:], strict=False))
        self.norms = tuple(BatchRenorm(size, NEVER) for size in sizes)
        self.activation = activation

    def __call__(self, x: Array) -> Array:
        """Maps ``(batch, n_inputs)`` to ``(batch, n_outputs)`` by the running statistics."""
        x = self.norms[0](x)
        for layer, norm in zip(self.layers, self.norms[1:], strict=True):
            x = ACTIVATIONS[self.activation](norm(layer(x)))
        return x


class InvertedBlock(eqx.Module):
    """``x + f(BN(W2 f(BN(W1 x))))``, wider inside than outside by :data:`EXPANSION`: an inverted residual block."""

    expand: UnitLinear
    inner: BatchRenorm
    contract: UnitLinear
    outer: BatchRenorm
    activation: str = eqx.field(static=True)

    def __init__(self, key: Array, width: int, activation: str) -> None:
        expand_key, contract_key = jax.random.split(key)
        self.expand = UnitLinear(expand_key, width, EXPANSION * width)
        self.inner = BatchRenorm(EXPANSION * width, NEVER, FINE)
        self.contract = UnitLinear(contract_key, EXPANSION * width, width)
        self.outer = BatchRenorm(width, NEVER, FINE)
        self.activation = activation

    def __call__(self, x: Array) -> Array:
        """Maps ``(batch, width)`` to ``(batch, width)`` by the running statistics."""
        f = ACTIVATIONS[self.activation]
        return x + f(self.outer(self.contract(f(self.inner(self.expand(x))))))


class InvertedResidual(eqx.Module):
    """A normalization of the input, a linear embedding, inverted residual blocks, an RMS norm (FlashSAC).

    The stream between the blocks is not normalized by batches; the RMS norm at the end bounds what reaches the head.
    """

    norm: BatchRenorm
    embedding: UnitLinear
    blocks: tuple[InvertedBlock, ...]
    last: RMSNorm

    def __init__(self, key: Array, n_inputs: int, widths: Sequence[int], activation: str) -> None:
        """Builds ``len(widths)`` blocks of the one width that ``widths`` repeats."""
        embedding_key, *block_keys = jax.random.split(key, 1 + len(widths))
        self.norm = BatchRenorm(n_inputs, NEVER, FINE)
        self.embedding = UnitLinear(embedding_key, n_inputs, widths[0])
        self.blocks = tuple(InvertedBlock(k, width, activation) for k, width in zip(block_keys, widths, strict=True))
        self.last = RMSNorm(widths[-1])

    @property
    def n_outputs(self) -> int:
        """Width of the stream."""
        return self.last.scale.shape[-1]

    def __call__(self, x: Array) -> Array:
        """Maps ``(batch, n_inputs)`` to ``(batch, n_outputs)`` by the running statistics."""
        x = self.embedding(self.norm(x))
        for block in self.blocks:
            x = block(x)
        return self.last(x)


def projected(network: Network) -> Network:
    """Returns a network, or several stacked, with the weights of each unit of its :class:`UnitLinear` scaled to norm 1.

    In an :class:`InvertedResidual` the ``d`` gains of each normalization, with its offsets if it has any, are scaled to the
    norm ``sqrt(d)``.
    """
    is_part = lambda node: isinstance(node, UnitLinear | RMSNorm | BatchRenorm)  # noqa: E731

    def scaled(node: PyTree) -> PyTree:
        if isinstance(node, UnitLinear):
            return eqx.tree_at(lambda layer: layer.weight, node, unit(node.weight, axis=-2))
        return jax.tree.map(with_gains, node, is_leaf=is_part) if isinstance(node, InvertedResidual) else node

    def with_gains(node: PyTree) -> PyTree:
        if isinstance(node, RMSNorm):
            return eqx.tree_at(lambda norm: norm.scale, node, unit(node.scale) * math.sqrt(node.scale.shape[-1]))
        if isinstance(node, BatchRenorm):
            n = node.scale.shape[-1]
            both = unit(jnp.concatenate([node.scale, node.offset], axis=-1)) * math.sqrt(n)
            return eqx.tree_at(lambda norm: (norm.scale, norm.offset), node, (both[..., :n], both[..., n:]))
        return scaled(node)

    return jax.tree.map(scaled, network, is_leaf=lambda node: isinstance(node, UnitLinear | InvertedResidual))


def unit(x: Array, axis: int = -1) -> Array:
    """Returns ``x`` divided by its Euclidean norms along an axis."""
    return x / jnp.sqrt(jnp.sum(jnp.square(x), axis=axis, keepdims=True) + 1e-12)
