"""The layers of all networks: linear maps, layer norm, and stacks of both."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from rejeu import xla

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "relu": jax.nn.relu,
    "tanh": jnp.tanh,
    "elu": jax.nn.elu,
    "gelu": jax.nn.gelu,
    "silu": jax.nn.silu,
    "leaky_relu": jax.nn.leaky_relu,
    "leakyrelu": jax.nn.leaky_relu,
    "sigmoid": jax.nn.sigmoid,
}


class Linear(eqx.Module):
    """An affine map ``x @ weight + bias``."""

    weight: Array
    """``(n_inputs, n_outputs)``."""
    bias: Array
    """``(n_outputs,)``."""

    def __init__(self, key: Array, n_inputs: int, n_outputs: int) -> None:
        """Draws weight and bias uniformly within ``1 / sqrt(n_inputs)`` of 0, PyTorch's default."""
        bound = 1.0 / math.sqrt(max(n_inputs, 1))
        weight_key, bias_key = jax.random.split(key)
        self.weight = jax.random.uniform(weight_key, (n_inputs, n_outputs), jnp.float32, -bound, bound)
        self.bias = jax.random.uniform(bias_key, (n_outputs,), jnp.float32, -bound, bound)

    @property
    def n_outputs(self) -> int:
        """Number of outputs, also of a stack of layers."""
        return self.bias.shape[-1]

    def __call__(self, x: Array) -> Array:
        """Maps ``(batch, n_inputs)`` to ``(batch, n_outputs)``."""
        return product(x, self.weight) + self.bias[None]


@jax.custom_vjp
def product(x: Array, weight: Array) -> Array:
    """Returns ``x @ weight`` for ``(..., n)`` and ``(n, m)``; with gradients that are fast on CPUs.

    The gradient of ``weight`` is ``x.T @ g``. XLA's matrix library for CPUs does not accept a transposed left
    side, and the fallback takes up to twice as long. So ``x`` is transposed first, behind a barrier that keeps XLA from fusing
    the two. Products with a single column do not gain from it.
    """
    return x @ weight


def _product_forward(x: Array, weight: Array) -> tuple[Array, tuple[Array, Array]]:
    return x @ weight, (x, weight)


def _product_backward(saved: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    x, weight = saved
    rows, row_gradients = x.reshape(-1, weight.shape[0]), gradient.reshape(-1, weight.shape[1])
    if weight.shape[1] == 1 or xla.platform() != "cpu":
        return gradient @ weight.T, rows.T @ row_gradients
    apart = jax.lax.optimization_barrier
    return gradient @ weight.T, apart(apart(rows.T) @ row_gradients)


product.defvjp(_product_forward, _product_backward)


class LayerNorm(eqx.Module):
    """Layer normalization over the last axis (Ba et al. 2016, arXiv 1607.06450)."""

    scale: Array
    """``(width,)``."""
    offset: Array
    """``(width,)``."""

    def __init__(self, width: int) -> None:
        self.scale = jnp.ones((width,), jnp.float32)
        self.offset = jnp.zeros((width,), jnp.float32)

    def __call__(self, x: Array) -> Array:
        """Returns ``x``, ``(..., width)``, with mean 0 and variance 1 along its last axis, scaled and shifted."""
        mean = jnp.mean(x, axis=-1, keepdims=True)
        centered = x - mean
        variance = jnp.mean(jnp.square(centered), axis=-1, keepdims=True)
        shape = (1,) * (x.ndim - 1) + (-1,)
        scale, offset = self.scale.reshape(shape), self.offset.reshape(shape)
        return centered * jax.lax.rsqrt(variance + 1e-5) * scale + offset


class MLP(eqx.Module):
    """Hidden layers, each a linear map, an optional layer norm and a nonlinearity. No output layer."""

    layers: tuple[Linear, ...]
    norms: tuple[LayerNorm, ...]
    activation: str = eqx.field(static=True)

    def __init__(self, key: Array, n_inputs: int, widths: Sequence[int], activation: str, layer_norm: bool) -> None:
        keys = jax.random.split(key, max(len(widths), 1))
        sizes = (n_inputs, *widths)
        self.layers = tuple(Linear(k, i, o) for k, i, o in zip(keys, sizes[:-1], sizes[1:], strict=False))
        self.norms = tuple(LayerNorm(width) for width in widths) if layer_norm else ()
        self.activation = activation

    def __call__(self, x: Array) -> Array:
        """Maps ``(batch, n_inputs)`` to ``(batch, widths[-1])``."""
        for i, layer in enumerate(self.layers):
            x = layer(x)
            if self.norms:
                x = self.norms[i](x)
            x = ACTIVATIONS[self.activation](x)
        return x
