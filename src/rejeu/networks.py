"""Neural networks: layers, perceptrons, and the actor and critics that algorithms put together from them.

Every network is an ``equinox.Module`` whose leaves are all arrays; what is static (names, shapes of observations) is
hashable. Inputs carry one batch axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from rejeu.core import PyTree
from rejeu.spaces import Leaf

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


@dataclass(frozen=True)
class PolicyConfig:
    """The shape of an agent's networks (Stable-Baselines3's ``policy_kwargs``)."""

    net_arch: tuple[int, ...] | None = None
    """Widths of the hidden layers of actor and critics; a mapping ``{"pi": [...], "qf": [...]}`` sets them apart.
    None leaves the algorithm's own default."""
    pi: tuple[int, ...] | None = None
    """Widths of the actor's hidden layers where they differ from ``net_arch``."""
    qf: tuple[int, ...] | None = None
    """Widths of each critic's hidden layers where they differ from ``net_arch``."""
    activation_fn: str = "relu"
    """Nonlinearity after each hidden layer: relu, tanh, elu, gelu, silu, leaky_relu or sigmoid. A function or class
    of that name (``jax.nn.relu``, ``torch.nn.ReLU``) is accepted too."""
    layer_norm: bool = False
    """Normalise each hidden layer before its nonlinearity: steadier critics, above all at high learning rates."""

    def __post_init__(self) -> None:
        arch = self.net_arch
        if isinstance(arch, Mapping):
            if unknown := set(arch) - {"pi", "qf"}:
                raise ValueError(f"net_arch has the unknown keys {sorted(unknown)}; expected 'pi' and 'qf'")
            for key in ("pi", "qf"):
                if key in arch and getattr(self, key) is None:
                    object.__setattr__(self, key, arch[key])
            object.__setattr__(self, "net_arch", None)
        for key in ("net_arch", "pi", "qf"):
            object.__setattr__(self, key, _widths(key, getattr(self, key)))
        name = self.activation_fn if isinstance(self.activation_fn, str) else self.activation_fn.__name__
        if name.lower() not in ACTIVATIONS:
            raise ValueError(f"activation_fn={name!r} is unknown; choose one of {', '.join(ACTIVATIONS)}")
        object.__setattr__(self, "activation_fn", name.lower())

    def actor_layers(self, default: tuple[int, ...]) -> tuple[int, ...]:
        """Returns the widths of the actor's hidden layers."""
        return next(arch for arch in (self.pi, self.net_arch, default) if arch is not None)

    def critic_layers(self, default: tuple[int, ...]) -> tuple[int, ...]:
        """Returns the widths of each critic's hidden layers."""
        return next(arch for arch in (self.qf, self.net_arch, default) if arch is not None)


def _widths(key: str, value: Any) -> tuple[int, ...] | None:
    if value is None:
        return None
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise TypeError(f"{key}={value!r} must be a list of layer widths, such as [256, 256]")
    if not all(isinstance(width, int) and not isinstance(width, bool) and width > 0 for width in value):
        raise ValueError(f"{key}={list(value)} must hold positive whole numbers, such as [256, 256]")
    return tuple(value)


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

    def __call__(self, x: Array) -> Array:
        """Maps ``(..., n_inputs)`` to ``(..., n_outputs)``."""
        return x @ self.weight + self.bias


class LayerNorm(eqx.Module):
    """Layer normalisation over the last axis (Ba et al. 2016, arXiv 1607.06450)."""

    scale: Array
    """``(width,)``."""
    offset: Array
    """``(width,)``."""

    def __init__(self, width: int) -> None:
        self.scale = jnp.ones((width,), jnp.float32)
        self.offset = jnp.zeros((width,), jnp.float32)

    def __call__(self, x: Array) -> Array:
        """Returns ``x`` with mean 0 and variance 1 along its last axis, scaled and shifted."""
        mean = jnp.mean(x, axis=-1, keepdims=True)
        centred = x - mean
        variance = jnp.mean(jnp.square(centred), axis=-1, keepdims=True)
        return centred * jax.lax.rsqrt(variance + 1e-5) * self.scale + self.offset


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
        """Maps ``(..., n_inputs)`` to ``(..., widths[-1])``."""
        for i, layer in enumerate(self.layers):
            x = layer(x)
            if self.norms:
                x = self.norms[i](x)
            x = ACTIVATIONS[self.activation](x)
        return x


class Encoder(eqx.Module):
    """Turns an observation of any structure into one feature vector, leaf by leaf."""

    leaves: tuple[Leaf, ...] = eqx.field(static=True)

    @property
    def n_features(self) -> int:
        """Length of the feature vector."""
        return sum(leaf.n_features for leaf in self.leaves)

    def __call__(self, obs: PyTree) -> Array:
        """Maps observations ``(batch, ...)`` to features ``(batch, n_features)``."""
        parts = [encode_leaf(leaf, x) for leaf, x in zip(self.leaves, jax.tree.leaves(obs), strict=True)]
        return parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=-1)


def encode_leaf(leaf: Leaf, x: Array) -> Array:
    """Returns ``(batch, leaf.n_features)``: flattened numbers, pixels in [0, 1], or one-hot vectors."""
    x = x.reshape(x.shape[0], -1)
    if leaf.kind == "categorical":
        parts = [
            jax.nn.one_hot(x[:, i] - start, size, dtype=jnp.float32)
            for i, (start, size) in enumerate(zip(leaf.starts, leaf.sizes, strict=True))
        ]
        return jnp.concatenate(parts, axis=-1)
    x = x.astype(jnp.float32)
    return x / 255.0 if leaf.kind == "image" else x


class Actor(eqx.Module):
    """Observation to the parameters of an action: encoder, hidden layers, one linear head."""

    encoder: Encoder
    torso: MLP
    head: Linear

    def __init__(self, key: Array, leaves: tuple[Leaf, ...], n_outputs: int, widths: Sequence[int], shape: PolicyConfig):
        torso_key, head_key = jax.random.split(key)
        self.encoder = Encoder(leaves)
        sizes = (self.encoder.n_features, *widths)
        self.torso = MLP(torso_key, sizes[0], widths, shape.activation_fn, shape.layer_norm)
        self.head = Linear(head_key, sizes[-1], n_outputs)

    def __call__(self, obs: PyTree) -> Array:
        """Maps observations ``(batch, ...)`` to ``(batch, n_outputs)``."""
        return self.head(self.torso(self.encoder(obs)))


class Critic(eqx.Module):
    """Observation and continuous action to action values: encoder, hidden layers, one linear head."""

    encoder: Encoder
    torso: MLP
    head: Linear

    def __init__(
        self,
        key: Array,
        leaves: tuple[Leaf, ...],
        action_dim: int,
        widths: Sequence[int],
        shape: PolicyConfig,
        n_outputs: int = 1,
    ):
        torso_key, head_key = jax.random.split(key)
        self.encoder = Encoder(leaves)
        sizes = (self.encoder.n_features + action_dim, *widths)
        self.torso = MLP(torso_key, sizes[0], widths, shape.activation_fn, shape.layer_norm)
        self.head = Linear(head_key, sizes[-1], n_outputs)

    def __call__(self, obs: PyTree, action: Array) -> Array:
        """Maps observations ``(batch, ...)`` and actions ``(batch, action_dim)`` to ``(batch, n_outputs)``."""
        return self.head(self.torso(jnp.concatenate([self.encoder(obs), action], axis=-1)))
