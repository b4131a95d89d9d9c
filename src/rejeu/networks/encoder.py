"""Encoders: observations of any structure to one vector of features."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from rejeu.core.algorithm import PyTree, unmasked
from rejeu.core.spaces import Leaf
from rejeu.networks.layers import LayerNorm, Linear, find_encoder, own_module
from rejeu.networks.shape import PolicyConfig


class Convolutions(NamedTuple):
    """A stack of convolutions and the width of the linear layer after it."""

    layers: tuple[tuple[int, int, int], ...]
    """Filters, side of the kernel and stride of each."""
    n_outputs: int


NATURE = Convolutions(((32, 8, 4), (64, 4, 2), (64, 3, 1)), 512)
"""For images whose shorter side has 36 pixels or more: Mnih et al. 2015, "Human-level control through deep
reinforcement learning" (Nature 518)."""
SMALL = Convolutions(((32, 4, 2), (64, 3, 1)), 256)
"""For images of 8 to 35 pixels on their shorter side. Smaller images are flattened."""


CHUNK = 256
"""Maximum number of images that go through convolutions at once: one of 84 by 84 pixels takes 1.2 MB of temporary memory."""


class Convolution(eqx.Module):
    """A two-dimensional convolution without padding, plus a bias. The stride divides the side of the kernel."""

    weight: Array
    """``(kernel, kernel, n_channels, n_filters)``."""
    bias: Array
    """``(n_filters,)``."""
    stride: int = eqx.field(static=True)

    def __init__(self, key: Array, n_channels: int, n_filters: int, kernel: int, stride: int) -> None:
        """Draws weight and bias uniformly within ``1 / sqrt(inputs of a filter)`` of 0, PyTorch's default."""
        assert kernel % stride == 0
        bound = 1.0 / math.sqrt(kernel * kernel * n_channels)
        weight_key, bias_key = jax.random.split(key)
        shape = (kernel, kernel, n_channels, n_filters)
        self.weight = jax.random.uniform(weight_key, shape, jnp.float32, -bound, bound)
        self.bias = jax.random.uniform(bias_key, (n_filters,), jnp.float32, -bound, bound)
        self.stride = stride

    def __call__(self, x: Array) -> Array:
        """Maps ``(batch, height, width, n_channels)`` to ``(batch, rows, columns, n_filters)``.

        One matrix product over patches, which takes half the time of XLA's convolution on a CPU. The image is divided
        into cells of ``stride`` by ``stride`` pixels, so that a patch consists of a few neighboring cells.
        """
        kernel, _, n_channels, n_filters = self.weight.shape
        stride, cells = self.stride, kernel // self.stride
        rows, columns = ((side - kernel) // stride + 1 for side in x.shape[1:3])
        down, across = rows + cells - 1, columns + cells - 1
        x = x[:, : down * stride, : across * stride]
        x = x.reshape(-1, down, stride, across, stride, n_channels).transpose(0, 1, 3, 2, 4, 5)
        x = x.reshape(-1, down, across, stride * stride * n_channels)
        patches = [x[:, i : i + rows, j : j + columns] for i in range(cells) for j in range(cells)]
        weight = self.weight.reshape(cells, stride, cells, stride, n_channels, n_filters).transpose(0, 2, 1, 3, 4, 5)
        weight = weight.reshape(kernel * kernel * n_channels, n_filters)
        return jnp.concatenate(patches, axis=-1) @ weight + self.bias[None, None, None]


class CNN(eqx.Module):
    """Pixels to features: convolutions and one linear layer, each followed by an optional layer norm and a relu."""

    layers: tuple[Convolution, ...]
    linear: Linear
    norms: tuple[LayerNorm, ...]
    """Over the channels of each layer; empty without layer norm."""
    scale: float = eqx.field(static=True)
    """Divisor of pixels."""

    def __init__(
        self, key: Array, shape: tuple[int, ...], design: Convolutions, layer_norm: bool = False, scale: float = 255.0
    ) -> None:
        *layer_keys, linear_key = jax.random.split(key, len(design.layers) + 1)
        height, width, channels = image_shape(shape)
        layers = []
        for layer_key, (n_filters, kernel, stride) in zip(layer_keys, design.layers, strict=True):
            layers.append(Convolution(layer_key, channels, n_filters, kernel, stride))
            height, width, channels = (height - kernel) // stride + 1, (width - kernel) // stride + 1, n_filters
        self.layers = tuple(layers)
        self.linear = Linear(linear_key, height * width * channels, design.n_outputs)
        widths = (*(n_filters for n_filters, _, _ in design.layers), design.n_outputs)
        self.norms = tuple(map(LayerNorm, widths)) if layer_norm else ()
        self.scale = scale

    def __call__(self, x: Array) -> Array:
        """Maps images ``(batch, ...)`` of 0 to 255 to features ``(batch, n_outputs)``, ``CHUNK`` images at a time."""
        return in_chunks(self.features, x, CHUNK)

    def features(self, x: Array) -> Array:
        """Returns the features of all images at once."""
        x = channels_last(x).astype(jnp.float32) / self.scale
        for i, layer in enumerate(self.layers):
            x = jax.nn.relu(self.normalized(i, layer(x)))
        return jax.nn.relu(self.normalized(-1, self.linear(x.reshape(x.shape[0], -1))))

    def normalized(self, i: int, x: Array) -> Array:
        """Returns the outputs of a layer after its layer norm, if there is one."""
        return self.norms[i](x) if self.norms else x


def in_chunks(function: Callable[[Array], Array], x: Array, size: int) -> Array:
    """Returns ``function(x)`` for a function of rows, computed ``size`` rows at a time.

    A gradient recomputes each chunk, so that intermediate values of only one chunk are kept.
    """
    n_chunks, remainder = divmod(x.shape[0], size)
    if n_chunks == 0 or (n_chunks == 1 and remainder == 0):
        return function(x)
    chunks = x[: n_chunks * size].reshape(n_chunks, size, *x.shape[1:])
    once = jax.checkpoint(lambda chunk: function(chunk), prevent_cse=False)  # checkpoint hashes the function
    parts = jax.lax.map(once, chunks)
    parts = parts.reshape(n_chunks * size, *parts.shape[2:])
    return parts if remainder == 0 else jnp.concatenate([parts, function(x[n_chunks * size :])])


class Encoder(eqx.Module):
    """Turns an observation of any structure into one feature vector, leaf by leaf; every image has its own CNN."""

    leaves: tuple[Leaf, ...] = eqx.field(static=True)
    images: tuple[CNN, ...]
    """In the order of the leaves that are images."""
    shape: PolicyConfig = eqx.field(static=True)

    def __init__(self, leaves: tuple[Leaf, ...], key: Array | None = None, shape: PolicyConfig | None = None) -> None:
        """Builds an encoder of these leaves; the key is needed only for images, which the settings ``shape`` are for too.

        Raises:
            TypeError: if there are images and no key.
        """
        self.leaves, self.shape = leaves, PolicyConfig() if shape is None else shape
        images: list[CNN] = []
        for leaf in leaves:
            if (layers := convolutions(leaf, self.shape)) is not None:
                if key is None:
                    raise TypeError("Encoder(leaves, key): the encoder of an image has weights and needs a key")
                scale = 255.0 if self.shape.normalize_images else 1.0
                image_key = jax.random.fold_in(key, len(images))
                images.append(CNN(image_key, leaf.shape, layers, self.shape.cnn_layer_norm, scale))
        self.images = tuple(images)

    @property
    def n_features(self) -> int:
        """Length of the feature vector."""
        layers_of_leaves = [convolutions(leaf, self.shape) for leaf in self.leaves]
        pairs = zip(self.leaves, layers_of_leaves, strict=True)
        return sum(leaf.n_features if layers is None else layers.n_outputs for leaf, layers in pairs)

    def __call__(self, obs: PyTree) -> Array:
        """Maps observations ``(batch, ...)`` to features ``(batch, n_features)``."""
        images = iter(self.images)
        parts = [
            encode_leaf(leaf, x, self.shape) if convolutions(leaf, self.shape) is None else next(images)(x)
            for leaf, x in zip(self.leaves, jax.tree.leaves(unmasked(obs)[0]), strict=True)
        ]
        return parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=-1)


class OwnEncoder(eqx.Module):
    """An encoder of the user's own."""

    leaves: tuple[Leaf, ...] = eqx.field(static=True)
    module: PyTree
    n_features: int = eqx.field(static=True)

    def __init__(self, key: Array, leaves: tuple[Leaf, ...], make: Callable[[Array, tuple[Leaf, ...]], PyTree]) -> None:
        """Builds ``make(key, leaves)``.

        Raises:
            TypeError: if that is no module which maps observations to vectors.
        """
        self.leaves = leaves
        role = f"encoder={getattr(make, '__name__', repr(make))}"
        example = self.arrange([jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves])
        self.module, self.n_features = own_module(role, make(key, leaves), example)

    def __call__(self, obs: PyTree) -> Array:
        """Maps observations ``(batch, ...)`` to features ``(batch, n_features)``."""
        return self.module(self.arrange(jax.tree.leaves(unmasked(obs)[0])))

    def arrange(self, arrays: list[PyTree]) -> PyTree:
        """Returns the argument of the module: an array, or for a Dict or Tuple space a dict from path to array."""
        paths = [leaf.path for leaf in self.leaves]
        return arrays[0] if paths == [""] else dict(zip(paths, arrays, strict=True))


def make_encoder(key: Array, leaves: tuple[Leaf, ...], shape: PolicyConfig) -> PyTree:
    """Returns the encoder of these leaves: rejeu's own, or the module of the user's."""
    if shape.encoder is not None:
        return OwnEncoder(key, leaves, find_encoder(shape.encoder))
    return Encoder(leaves, key, shape)


def reads_image(leaves: tuple[Leaf, ...], shape: PolicyConfig | None = None) -> bool:
    """Returns whether an observation is one image, or one stack of images, that convolutions read.

    A Dict or Tuple is not.
    """
    return len(leaves) == 1 and not leaves[0].path and convolutions(leaves[0], shape) is not None


def convolutions(leaf: Leaf, shape: PolicyConfig | None = None) -> Convolutions | None:
    """Returns the convolutions for an observation with the settings ``shape``, None if it is no image or too small."""
    is_scaled = shape is not None and not shape.normalize_images and leaf.kind != "categorical"
    if (leaf.dtype != "uint8" and not is_scaled) or len(leaf.shape) not in (3, 4):
        return None
    side = min(image_shape(leaf.shape)[:2])
    layers = NATURE if side >= 36 else SMALL if side >= 8 else None
    width = None if shape is None else shape.cnn_features
    return layers if layers is None or width is None else layers._replace(n_outputs=width)


def image_shape(shape: tuple[int, ...]) -> tuple[int, int, int]:
    """Returns height, width and channels of an image of 3 axes, or of a stack of images of 4.

    The channels come first if the first axis is the shortest, else last, as in Stable-Baselines3. Frames of a
    stack become channels.

    >>> image_shape((84, 84, 3)), image_shape((4, 84, 84)), image_shape((4, 96, 96, 3))
    ((84, 84, 3), (84, 84, 4), (96, 96, 12))
    """
    if len(shape) == 4:
        height, width, channels = image_shape(shape[1:])
        return height, width, shape[0] * channels
    first = min(shape) == shape[0]
    return (shape[1], shape[2], shape[0]) if first else (shape[0], shape[1], shape[2])


def channels_last(x: Array) -> Array:
    """Returns a batch of images ``(batch, ...)`` as ``(batch, height, width, channels)``; see :func:`image_shape`."""
    if x.ndim == 5:
        n, frames = x.shape[:2]
        x = channels_last(x.reshape(n * frames, *x.shape[2:]))
        x = jnp.moveaxis(x.reshape(n, frames, *x.shape[1:]), 1, 3)
        return x.reshape(*x.shape[:3], -1)
    return jnp.moveaxis(x, 1, 3) if min(x.shape[1:]) == x.shape[1] else x


def encode_leaf(leaf: Leaf, x: Array, shape: PolicyConfig) -> Array:
    """Returns ``(batch, leaf.n_features)``: flattened numbers, pixels in [0, 1], or one-hot vectors."""
    x = x.reshape(x.shape[0], -1)
    if leaf.kind == "categorical":
        parts = [
            jax.nn.one_hot(x[:, i] - start, size, dtype=jnp.float32)
            for i, (start, size) in enumerate(zip(leaf.starts, leaf.sizes, strict=True))
        ]
        return jnp.concatenate(parts, axis=-1)
    x = x.astype(jnp.float32)
    return x / 255.0 if leaf.kind == "image" and shape.normalize_images else x
