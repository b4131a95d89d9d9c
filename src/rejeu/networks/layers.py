"""The layers of all networks: linear maps, layer norm, stacks of both, and modules of the user's own."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, ShapeDtypeStruct

from rejeu.core import xla
from rejeu.core.algorithm import PyTree

M = TypeVar("M", bound=Callable[..., object])
ENCODERS: dict[str, Callable[..., PyTree]] = {}
"""Encoders by name; :func:`register_encoder` adds to it."""

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


class RMSNorm(eqx.Module):
    """Root mean square normalization over the last axis (Zhang and Sennrich 2019, arXiv 1910.07467): no mean, no offset."""

    scale: Array
    """``(width,)``."""

    def __init__(self, width: int) -> None:
        self.scale = jnp.ones((width,), jnp.float32)

    def __call__(self, x: Array) -> Array:
        """Returns ``x``, ``(..., width)``, divided by the root of the mean square along its last axis, times the scale."""
        scale = self.scale.reshape((1,) * (x.ndim - 1) + (-1,))
        return x * jax.lax.rsqrt(jnp.mean(jnp.square(x), axis=-1, keepdims=True) + 1e-6) * scale


class Dropout(eqx.Module):
    """Sets each number to 0 with probability ``rate`` and divides the others by ``1 - rate`` (Srivastava et al. 2014).

    It does so only with a key, which :func:`with_dropout` gives it for one forward pass.
    """

    key: Array | None
    rate: float = eqx.field(static=True)

    def __call__(self, x: Array) -> Array:
        """Returns ``x`` of any shape, some of it dropped; unchanged without a key."""
        if self.key is None:
            return x
        is_kept = jax.random.bernoulli(self.key, 1.0 - self.rate, x.shape)
        return jnp.where(is_kept, x / (1.0 - self.rate), 0.0)


def with_dropout(networks: PyTree, key: Array | None) -> PyTree:
    """Returns stacked networks whose dropout layers draw from ``key``, each layer its own numbers; unchanged for None."""
    if key is None:
        return networks
    n = jax.tree.leaves(networks)[-1].shape[0]
    is_dropout = lambda node: isinstance(node, Dropout)  # noqa: E731
    nodes, tree = jax.tree.flatten(networks, is_leaf=is_dropout)
    keys = [jax.random.split(jax.random.fold_in(key, i), n) for i in range(len(nodes))]
    pairs = zip(nodes, keys, strict=True)
    return jax.tree.unflatten(tree, [Dropout(k, node.rate) if is_dropout(node) else node for node, k in pairs])


class MLP(eqx.Module):
    """Hidden layers, each a linear map, an optional dropout and layer norm, and a nonlinearity. No output layer."""

    layers: tuple[Linear, ...]
    norms: tuple[LayerNorm, ...]
    dropouts: tuple[Dropout, ...]
    activation: str = eqx.field(static=True)

    def __init__(
        self,
        key: Array,
        n_inputs: int,
        widths: Sequence[int],
        activation: str,
        layer_norm: bool,
        dropout: float = 0.0,
    ) -> None:
        keys = jax.random.split(key, max(len(widths), 1))
        sizes = (n_inputs, *widths)
        self.layers = tuple(Linear(k, i, o) for k, i, o in zip(keys, sizes[:-1], sizes[1:], strict=False))
        self.norms = tuple(LayerNorm(width) for width in widths) if layer_norm else ()
        self.dropouts = tuple(Dropout(None, dropout) for _ in widths) if dropout else ()
        self.activation = activation

    def __call__(self, x: Array) -> Array:
        """Maps ``(batch, n_inputs)`` to ``(batch, widths[-1])``."""
        for i, layer in enumerate(self.layers):
            x = layer(x)
            if self.dropouts:
                x = self.dropouts[i](x)
            if self.norms:
                x = self.norms[i](x)
            x = ACTIVATIONS[self.activation](x)
        return x


def register_encoder(name: str) -> Callable[[M], M]:
    """Returns a decorator that makes an encoder known by a name, which ``policy_kwargs`` and model files can contain.

    A later registration of the same name replaces the earlier one.

    >>> @register_encoder("numbers")
    ... def numbers(key, leaves):
    ...     return eqx.nn.Linear(leaves[0].n_features, 8, key=key)
    >>> import rejeu
    >>> agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"encoder": "numbers"})
    """

    def register(make: M) -> M:
        ENCODERS[name] = make
        return make

    return register


def find_encoder(encoder: PyTree) -> PyTree:
    """Returns the encoder of a name; anything but a name is returned unchanged.

    Raises:
        ValueError: if the name is not registered.
    """
    if not isinstance(encoder, str):
        return encoder
    if encoder not in ENCODERS:
        raise ValueError(
            f"encoder={encoder!r} is not registered; import the module that registers it (--import MODULE); there are "
            f"{', '.join(ENCODERS) or 'none'}"
        )
    return ENCODERS[encoder]


class OwnModule(eqx.Module):
    """A module of the user's own that is not called with a batch, or that holds functions, as ``eqx.nn.MLP`` does.

    Its arrays are learned; everything else, such as an activation function, is constant.
    """

    arrays: PyTree
    """The module, with None in place of what is no array."""
    constants: PyTree = eqx.field(static=True)
    """The module, with None in place of arrays."""
    takes_batch: bool = eqx.field(static=True)
    n_outputs: int = eqx.field(static=True)

    def __call__(self, x: PyTree) -> Array:
        """Maps ``(batch, ...)`` to ``(batch, n_outputs)``."""
        module = eqx.combine(self.arrays, self.constants)
        return module(x) if self.takes_batch else jax.vmap(module)(x)


def own_module(role: str, module: PyTree, example: PyTree) -> tuple[PyTree, int]:
    """Returns a module of the user's own as one that takes a batch, and the number of its outputs.

    Args:
        role: the setting it was given as, with its name, for messages.
        module: maps inputs ``(batch, ...)`` to ``(batch, n_outputs)``, or one input to ``(n_outputs,)``.
        example: shape and dtype of one input, without the batch axis.

    Raises:
        TypeError: if it is no ``equinox.Module``, does not map such inputs, or holds arrays that are not float32.
    """
    if not isinstance(module, eqx.Module):
        raise TypeError(f"{role} made {type(module).__name__}, expected an equinox.Module")
    for path, leaf in jax.tree_util.tree_leaves_with_path(module):
        if eqx.is_array_like(leaf) and not (isinstance(leaf, jax.Array) and leaf.dtype == jnp.float32):
            leaf_type = f"array of {leaf.dtype}" if hasattr(leaf, "dtype") else type(leaf).__name__
            where = jax.tree_util.keystr(path, simple=True, separator=".")
            raise TypeError(
                f"{role} holds {where}, which is of type {leaf_type} and cannot be learned; declare that field "
                "eqx.field(static=True)"
            )
    size = 2 + sum(sum(leaf.shape) for leaf in jax.tree.leaves(example))  # no axis of the input has that length
    batch = jax.tree.map(lambda leaf: ShapeDtypeStruct((size, *leaf.shape), leaf.dtype), example)
    takes_batch = True
    n_outputs = outputs_of(module, batch, (size,))
    if n_outputs is None:
        takes_batch, n_outputs = False, outputs_of(module, example, ())
    if n_outputs is None:
        shapes = jax.tree.map(lambda leaf: leaf.shape, example)
        raise TypeError(
            f"{role} must map inputs of shape {shapes} to a vector, or a batch of them to (batch, n_outputs)"
        )
    arrays, constants = eqx.partition(module, eqx.is_array)
    is_complete = takes_batch and not jax.tree.leaves(constants)
    if is_complete and getattr(module, "n_outputs", None) == n_outputs:
        return module, n_outputs
    return OwnModule(arrays, constants, takes_batch, n_outputs), n_outputs


def outputs_of(module: PyTree, inputs: PyTree, leading: tuple[int, ...]) -> int | None:
    """Returns the length of the last axis that ``module`` gives for ``inputs``, None if it gives another shape."""
    try:
        shape = eqx.filter_eval_shape(module, inputs).shape
    except Exception:  # whatever a module raises for inputs that it is not made for
        return None
    return shape[-1] if len(shape) == len(leading) + 1 and shape[:-1] == leading else None
