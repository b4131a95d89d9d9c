"""Noisy networks: linear layers whose weights are normal distributions with learned means and scales.

Source: Fortunato et al. 2018, "Noisy Networks for Exploration" (arXiv 1706.10295), with factorized noise. For ``p`` inputs,
and ``e_i`` and ``e_j`` from a standard normal distribution for every input and output::

    f(x) = sign(x) sqrt|x|
    w_ij = mean_ij + scale_ij f(e_i) f(e_j)           b_j = mean_j + scale_j f(e_j)          equations 10 and 11
    mean ~ U(-1 / sqrt p, 1 / sqrt p)                 scale = 0.5 / sqrt p                   section 3.2
"""

from __future__ import annotations

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from rejeu.core.algorithm import PyTree
from rejeu.networks.layers import Linear, product

SCALE = 0.5
"""Initial scale of the noise for one input; that of the paper."""


class NoisyLinear(eqx.Module):
    """An affine map, without noise until it is :func:`drawn`."""

    weight: Array
    """Means, ``(n_inputs, n_outputs)``."""
    bias: Array
    """Means, ``(n_outputs,)``."""
    weight_scale: Array
    bias_scale: Array

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return self.bias.shape[-1]

    def __call__(self, x: Array) -> Array:
        """Maps ``(batch, n_inputs)`` to ``(batch, n_outputs)``."""
        return product(x, self.weight) + self.bias[None]

    def drawn(self, key: Array) -> NoisyLinear:
        """Returns the layer with weights drawn from its distributions."""
        n_inputs, n_outputs = self.weight.shape
        noise = jax.random.normal(key, (n_inputs + n_outputs,), jnp.float32)
        noise = jnp.sign(noise) * jnp.sqrt(jnp.abs(noise))
        weight = self.weight + self.weight_scale * noise[:n_inputs, None] * noise[None, n_inputs:]
        return dataclasses.replace(self, weight=weight, bias=self.bias + self.bias_scale * noise[n_inputs:])


def noisy(network: PyTree) -> PyTree:
    """Returns a network with a :class:`NoisyLinear` in place of every linear layer, of the same means."""

    def replaced(layer: PyTree) -> PyTree:
        if not isinstance(layer, Linear):
            return layer
        scale = SCALE / math.sqrt(max(layer.weight.shape[0], 1))
        scales = jnp.full_like(layer.weight, scale), jnp.full_like(layer.bias, scale)
        return NoisyLinear(layer.weight, layer.bias, *scales)

    return jax.tree.map(replaced, network, is_leaf=lambda node: isinstance(node, Linear))


def drawn(network: PyTree, key: Array | None) -> PyTree:
    """Returns a network with the weights of all its noisy layers drawn, independently; unchanged if the key is None."""
    if key is None:
        return network
    is_noisy = lambda node: isinstance(node, NoisyLinear)  # noqa: E731
    parts, structure = jax.tree.flatten(network, is_leaf=is_noisy)
    keys = jax.random.split(jax.random.fold_in(key, 1), len(parts))
    drawn = [module.drawn(key) if is_noisy(module) else module for module, key in zip(parts, keys, strict=True)]
    return jax.tree.unflatten(structure, drawn)
