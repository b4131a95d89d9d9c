"""Batch renormalization: batch normalization that is the same function in training and in use.

Source: Ioffe 2017, "Batch Renormalization" (arXiv 1702.03275, algorithm 1). With mean and standard deviation ``m_B``,
``s_B`` of the batch, the running ones ``m``, ``s``, and clip bounds ``r_max``, ``d_max``::

    r = clip(s_B / s, 1 / r_max, r_max)         d = clip((m_B - m) / s, -d_max, d_max)         without gradient
    y = scale ((x - m_B) / s_B r + d) + offset                                                  in training
    y = scale (x - m) / s + offset                                                              in use

Without clipping the two are equal, but in training the gradient flows through the batch's statistics.
During the warm-up ``r = 1`` and ``d = 0``: plain batch normalization. Running statistics are exponential averages
with the rate 0.01. The paper averages ``s``, we average its square, as CrossQ's authors do.

The running statistics are arrays of the network like its weights, but they are not learned by gradient: :func:`in_training`
returns the output and the network with updated statistics. Because an optimizer's step starts from the previous network,
:func:`with_statistics` combines the two::

    (loss, trained), gradients = jax.value_and_grad(loss_that_returns_trained, has_aux=True)(network)
    network = with_statistics(descend(network, gradients, ...), trained)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax

from rejeu.core.algorithm import PyTree
from rejeu.core.spaces import Leaf
from rejeu.networks.encoder import Encoder
from rejeu.networks.layers import ACTIVATIONS, Linear

Network = TypeVar("Network")

MOMENTUM = 0.99
"""Decay of the running statistics (arXiv 1902.05605, table of hyperparameters)."""
EPSILON = 1e-3
"""Added to every variance, in the square of the input's unit."""
R_MAX = 3.0
"""Maximum ratio of the batch's and the running standard deviation."""
D_MAX = 5.0
"""Maximum difference of their means, in running standard deviations."""
NEVER = 2**31 - 1
"""A warm-up that does not end: plain batch normalization."""


class BatchRenorm(eqx.Module):
    """Normalizes each feature over the batch axis."""

    scale: Array
    """``(width,)``, learned."""
    offset: Array
    """``(width,)``, learned."""
    mean: Array
    """Running mean of the input, ``(width,)``."""
    variance: Array
    """Running variance of the input, biased (divided by the batch size), ``(width,)``."""
    n_batches: Array
    """Training steps so far, ``float32[]`` so that JAX can differentiate the network. It stops growing at 2^24, long after
    the warm-up."""
    warm_up: int = eqx.field(static=True)
    """Training steps of plain batch normalization at the beginning."""
    epsilon: float = eqx.field(static=True)

    def __init__(self, width: int, warm_up: int, epsilon: float = EPSILON) -> None:
        self.scale = jnp.ones((width,), jnp.float32)
        self.offset = jnp.zeros((width,), jnp.float32)
        self.mean = jnp.zeros((width,), jnp.float32)
        self.variance = jnp.ones((width,), jnp.float32)
        self.n_batches = jnp.zeros((), jnp.float32)
        self.warm_up, self.epsilon = warm_up, epsilon

    def __call__(self, x: Array) -> Array:
        """Normalizes ``(batch, width)`` by the running statistics."""
        mean, variance = lax.stop_gradient((self.mean, self.variance))
        factor = self.scale * lax.rsqrt(variance + self.epsilon)
        return x * factor[None] + (self.offset - mean * factor)[None]

    def train(self, x: Array) -> tuple[Array, BatchRenorm]:
        """Normalizes ``(batch, width)`` by its own statistics, corrected; also returns the layer with updated statistics."""
        batch_mean = jnp.mean(x, axis=0)
        centered = x - batch_mean[None]
        batch_variance = jnp.mean(jnp.square(centered), axis=0)
        batch_deviation = jnp.sqrt(batch_variance + self.epsilon)
        ratio, shift = lax.stop_gradient(self._correction(batch_mean, batch_deviation))
        factor = self.scale * ratio / batch_deviation
        y = centered * factor[None] + (self.scale * shift + self.offset)[None]
        mean = MOMENTUM * self.mean + (1.0 - MOMENTUM) * batch_mean
        variance = MOMENTUM * self.variance + (1.0 - MOMENTUM) * batch_variance
        moved = lax.stop_gradient((mean, variance, self.n_batches + 1.0))
        return y, eqx.tree_at(_statistics, self, moved)

    def _correction(self, batch_mean: Array, batch_deviation: Array) -> tuple[Array, Array]:
        """Returns ``r`` and ``d`` of the paper, ``(width,)`` each."""
        if self.warm_up == NEVER:
            return jnp.ones_like(self.scale), jnp.zeros_like(self.scale)
        deviation = jnp.sqrt(self.variance + self.epsilon)
        ratio = jnp.clip(batch_deviation / deviation, 1.0 / R_MAX, R_MAX)
        shift = jnp.clip((batch_mean - self.mean) / deviation, -D_MAX, D_MAX)
        warm = self.n_batches >= self.warm_up
        return jnp.where(warm, ratio, 1.0), jnp.where(warm, shift, 0.0)


class RenormalizedMLP(eqx.Module):
    """Hidden layers: a renormalization of the input, then each a linear map, a nonlinearity and a renormalization."""

    layers: tuple[Callable[[Array], Array], ...]
    norms: tuple[BatchRenorm, ...]
    """Of the input, then of what each layer gives: one more than layers."""
    activation: str = eqx.field(static=True)

    def __init__(self, key: Array, n_inputs: int, widths: Sequence[int], activation: str, warm_up: int) -> None:
        keys = jax.random.split(key, max(len(widths), 1))
        sizes = (n_inputs, *widths)
        self.layers = tuple(Linear(k, i, o) for k, i, o in zip(keys, sizes[:-1], sizes[1:], strict=False))
        self.norms = tuple(BatchRenorm(size, warm_up) for size in sizes)
        self.activation = activation

    @property
    def n_outputs(self) -> int:
        """Width of the last layer."""
        return self.norms[-1].scale.shape[-1]

    def __call__(self, x: Array) -> Array:
        """Maps ``(batch, n_inputs)`` to ``(batch, n_outputs)`` by the running statistics."""
        x = self.norms[0](x)
        for layer, norm in zip(self.layers, self.norms[1:], strict=True):
            x = norm(ACTIVATIONS[self.activation](layer(x)))
        return x


class RenormalizedNetwork(eqx.Module):
    """Observation, and for a critic the action, to numbers: encoder, normalized hidden layers, one linear head."""

    encoder: Encoder
    torso: PyTree
    head: PyTree

    def __init__(
        self,
        key: Array,
        leaves: tuple[Leaf, ...],
        action_dim: int | None,
        n_outputs: int,
        make_torso: Callable[[Array, int], PyTree],
        make_head: Callable[[Array, int, int], PyTree] = Linear,
    ) -> None:
        """Draws the weights.

        Args:
            key: for the weights.
            leaves: those of the observations.
            action_dim: None for a network that is given no action.
            n_outputs: how many numbers come out.
            make_torso: ``make_torso(key, n_inputs)`` returns hidden layers with ``n_outputs``.
            make_head: ``make_head(key, n_inputs, n_outputs)`` returns the last layer.
        """
        encoder_key, torso_key, head_key = jax.random.split(key, 3)
        self.encoder = Encoder(leaves, encoder_key)
        self.torso = make_torso(torso_key, self.encoder.n_features + (action_dim or 0))
        self.head = make_head(head_key, self.torso.n_outputs, n_outputs)

    def __call__(self, obs: PyTree, action: Array | None = None) -> Array:
        """Maps observations ``(batch, ...)`` to ``(batch, n_outputs)`` by the running statistics.

        A critic is given actions ``(batch, action_dim)`` as well.
        """
        features = self.encoder(obs)
        features = features if action is None else jnp.concatenate([features, action], axis=-1)
        return self.head(self.torso(features))


def with_statistics(network: Network, trained: Network) -> Network:
    """Returns ``network`` with the running statistics of ``trained``, a network of the same structure."""

    def take(node: PyTree, trained_node: PyTree) -> PyTree:
        return eqx.tree_at(_statistics, node, _statistics(trained_node)) if isinstance(node, BatchRenorm) else node

    return jax.tree.map(take, network, trained, is_leaf=lambda node: isinstance(node, BatchRenorm))


def in_training(network: Network, use: Callable[[Network], Array]) -> tuple[Array, Network]:
    """Returns ``use(network)`` by the batch's statistics, and the network with updated statistics.

    ``use`` must call each normalization once, and be traced with the call.
    """
    parts, structure = jax.tree.flatten(network, is_leaf=lambda node: isinstance(node, BatchRenorm))
    updated = [*parts]

    def recorded(i: int, norm: BatchRenorm) -> Callable[[Array], Array]:
        def normalized(x: Array) -> Array:
            y, updated[i] = norm.train(x)
            return y

        return normalized

    recorders = [recorded(i, module) if isinstance(module, BatchRenorm) else module for i, module in enumerate(parts)]
    return use(jax.tree.unflatten(structure, recorders)), jax.tree.unflatten(structure, updated)


def is_normalized(network: PyTree) -> bool:
    """Returns whether a network has a :class:`BatchRenorm`."""
    is_norm = lambda node: isinstance(node, BatchRenorm)  # noqa: E731
    return any(map(is_norm, jax.tree.leaves(network, is_leaf=is_norm)))


def _statistics(norm: BatchRenorm) -> tuple[Array, Array, Array]:
    return norm.mean, norm.variance, norm.n_batches
