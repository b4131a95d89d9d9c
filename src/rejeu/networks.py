"""Neural networks: layers, and the actor and critics that algorithms put together from them.

A network is an encoder (observation to features, images by convolution), a torso (hidden layers) and one linear head.
The torso is a perceptron, a net of branches, SimBa or a module of the user's. Every network is an ``equinox.Module``
whose leaves are all arrays; what is static (names, shapes of observations) is hashable. Inputs carry one batch axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

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

BRANCHES = ("state_layers", "action_layers", "common_layers", "critic_layers", "actor_layers")
"""Settings of ``PolicyConfig`` of which any one turns the branch shape on."""


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
    architecture: Literal["mlp", "simba"] = "mlp"
    """``simba``: residual blocks with layer norm (arXiv 2410.09754) in place of plain layers; ``net_arch`` then holds
    one number a block, all equal, and is made from ``n_blocks`` and ``width`` where it is None."""
    n_blocks: int = 2
    """Residual blocks of ``simba`` in each network. Raising it computes deeper and slower."""
    width: int = 128
    """Width of ``simba``'s residual stream; inside a block it is 4 times that."""
    state_layers: tuple[int, ...] = ()
    """Widths of the branch that only the observation goes through. Any of the five branch settings turns the branch
    shape on: critics join a state and an action branch, the actor has the state branch alone."""
    action_layers: tuple[int, ...] = ()
    """Widths of the critics' branch that only the action goes through."""
    common_layers: tuple[int, ...] = ()
    """Widths after the branches have met; actor and critics have layers of this shape each, they share no weights."""
    critic_layers: tuple[int, ...] = ()
    """Widths between the common layers and the critics' values."""
    actor_layers: tuple[int, ...] = ()
    """Widths between the common layers and the actor's outputs."""
    torso: Callable[[Array, int], Any] | None = None
    """Hidden layers of your own in every network: ``torso(key, n_inputs)`` returns an ``equinox.Module`` that maps
    ``(batch, n_inputs)`` to ``(batch, n_outputs)`` and has the static attribute ``n_outputs``. A model file keeps its
    name only: give it again to ``load``."""

    def __post_init__(self) -> None:
        put = lambda key, value: object.__setattr__(self, key, value)  # noqa: E731
        arch = self.net_arch
        if isinstance(arch, Mapping):
            if unknown := set(arch) - {"pi", "qf"}:
                raise ValueError(f"net_arch has the unknown keys {sorted(unknown)}; expected 'pi' and 'qf'")
            for key in ("pi", "qf"):
                if key in arch and getattr(self, key) is None:
                    put(key, arch[key])
            put("net_arch", None)
        for key in ("net_arch", "pi", "qf"):
            put(key, _widths(key, getattr(self, key)))
        for key in BRANCHES:
            put(key, _widths(key, getattr(self, key)) or ())
        for key in ("n_blocks", "width"):
            value = getattr(self, key)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{key}={value!r} must be a whole number of at least 1")
        name = self.activation_fn if isinstance(self.activation_fn, str) else self.activation_fn.__name__
        if name.lower() not in ACTIVATIONS:
            raise ValueError(f"activation_fn={name!r} is unknown; choose one of {', '.join(ACTIVATIONS)}")
        put("activation_fn", name.lower())
        if not isinstance(self.layer_norm, bool):
            raise TypeError(f"layer_norm={self.layer_norm!r} must be True or False")
        self._check_shape()

    def _check_shape(self) -> None:
        """Raises where settings contradict each other: there is one way to shape a network at a time."""
        if self.architecture not in ("mlp", "simba"):
            raise ValueError(f"architecture={self.architecture!r} must be 'mlp' or 'simba'")
        if self.torso is not None and not callable(self.torso):
            raise TypeError(f"torso={self.torso!r} must be a class or function: torso(key, n_inputs) -> equinox.Module")
        arch = [key for key in ("net_arch", "pi", "qf") if getattr(self, key) is not None]
        branches = [key for key in BRANCHES if getattr(self, key)]
        simba = ["architecture='simba'"] * (self.architecture == "simba")
        own = ["torso"] * (self.torso is not None)
        norm = ["layer_norm"] * self.layer_norm
        pairs = [(branches, arch), (branches, simba), (simba, norm)]
        for one, other in pairs + [(own, others) for others in (arch, branches, simba, norm)]:
            if one and other:
                raise ValueError(f"policy_kwargs: {one[0]} leaves {other[0]} without meaning; give one of the two")
        if simba and any(len(set(getattr(self, key))) != 1 for key in arch):
            raise ValueError(
                f"architecture='simba' has one width throughout: {arch[0]}={list(getattr(self, arch[0]))} must hold "
                "equal numbers, one a block, such as [128, 128]"
            )

    @property
    def has_branches(self) -> bool:
        """Whether the networks are nets of branches."""
        return any(getattr(self, key) for key in BRANCHES)

    def actor_widths(self, default: tuple[int, ...]) -> tuple[int, ...]:
        """Returns the widths of the actor's hidden layers: of its last part with branches, of each block with SimBa."""
        return self._chosen(self.pi, self.actor_layers, default)

    def critic_widths(self, default: tuple[int, ...]) -> tuple[int, ...]:
        """Returns the widths of each critic's hidden layers, likewise."""
        return self._chosen(self.qf, self.critic_layers, default)

    def _chosen(
        self, arch: tuple[int, ...] | None, branch: tuple[int, ...], default: tuple[int, ...]
    ) -> tuple[int, ...]:
        if self.torso is not None:
            return ()
        if self.has_branches:
            return branch
        simba = (self.width,) * self.n_blocks if self.architecture == "simba" else default
        return next(widths for widths in (arch, self.net_arch, simba) if widths is not None)


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
        """Maps ``(batch, n_inputs)`` to ``(batch, n_outputs)``."""
        return x @ self.weight + self.bias[None]


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
        return centred * jax.lax.rsqrt(variance + 1e-5) * self.scale[None] + self.offset[None]


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


class Branches(eqx.Module):
    """Hidden layers that observation and action go through apart before they meet; see ``docs/networks.md``."""

    state: MLP
    action: MLP | None
    """None in an actor."""
    common: MLP
    last: MLP

    def __init__(
        self, key: Array, n_features: int, action_dim: int | None, widths: Sequence[int], shape: PolicyConfig
    ) -> None:
        """Builds the branches of ``shape``, ``widths`` being those of the last part; no action branch for None."""
        keys = jax.random.split(key, 4)
        layers = lambda k, n_inputs, sizes: MLP(k, n_inputs, sizes, shape.activation_fn, shape.layer_norm)  # noqa: E731
        self.state = layers(keys[0], n_features, shape.state_layers)
        self.action = None if action_dim is None else layers(keys[1], action_dim, shape.action_layers)
        n_joined = (n_features, *shape.state_layers)[-1]
        n_joined += 0 if action_dim is None else (action_dim, *shape.action_layers)[-1]
        self.common = layers(keys[2], n_joined, shape.common_layers)
        self.last = layers(keys[3], (n_joined, *shape.common_layers)[-1], widths)

    def __call__(self, features: Array, action: Array | None = None) -> Array:
        """Maps features ``(batch, n_features)`` and actions ``(batch, action_dim)`` to ``(batch, n_outputs)``."""
        x = self.state(features)
        if self.action is not None:
            assert action is not None
            x = jnp.concatenate([x, self.action(action)], axis=-1)
        return self.last(self.common(x))


class ResidualBlock(eqx.Module):
    """``x + W2 f(W1 LayerNorm(x))``, four times as wide inside."""

    norm: LayerNorm
    expand: Linear
    contract: Linear
    activation: str = eqx.field(static=True)

    def __init__(self, key: Array, width: int, activation: str) -> None:
        expand_key, contract_key = jax.random.split(key)
        self.norm = LayerNorm(width)
        self.expand = Linear(expand_key, width, 4 * width)
        self.contract = Linear(contract_key, 4 * width, width)
        self.activation = activation

    def __call__(self, x: Array) -> Array:
        """Maps ``(batch, width)`` to the same shape."""
        return x + self.contract(ACTIVATIONS[self.activation](self.expand(self.norm(x))))


class SimBa(eqx.Module):
    """A linear embedding, residual blocks and a final layer norm.

    Source: Lee et al. 2024, "SimBa: Simplicity Bias for Scaling Up Parameters in Deep Reinforcement Learning" (arXiv
    2410.09754). The paper's running normalisation of observations is not part of it: give the agent ``normalize=True`` if
    their scales differ much. Nor is there a layer norm at the entrance, which would mix the units of unlike observations.
    Weights are drawn as in all our layers rather than as the authors draw them.
    """

    embedding: Linear
    blocks: tuple[ResidualBlock, ...]
    norm: LayerNorm

    def __init__(self, key: Array, n_inputs: int, widths: Sequence[int], activation: str) -> None:
        """Builds ``len(widths)`` blocks of the one width that ``widths`` repeats."""
        embedding_key, *block_keys = jax.random.split(key, 1 + len(widths))
        self.embedding = Linear(embedding_key, n_inputs, widths[0])
        self.blocks = tuple(ResidualBlock(k, width, activation) for k, width in zip(block_keys, widths, strict=True))
        self.norm = LayerNorm(widths[-1])

    def __call__(self, x: Array) -> Array:
        """Maps ``(batch, n_inputs)`` to ``(batch, width)``."""
        x = self.embedding(x)
        for block in self.blocks:
            x = block(x)
        return self.norm(x)


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

        One matrix product over patches: on a CPU half the time of XLA's own convolution, which becomes a grouped one
        where critics are stacked. The image is cut into cells of ``stride`` by ``stride`` pixels, so that a patch is a
        few neighbouring cells.
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


class Convolutions(NamedTuple):
    """A stack of convolutions and the width of the linear layer after it."""

    layers: tuple[tuple[int, int, int], ...]
    """Filters, side of the kernel and stride of each."""
    n_outputs: int


NATURE = Convolutions(((32, 8, 4), (64, 4, 2), (64, 3, 1)), 512)
"""For images whose shorter side has 36 pixels or more: Mnih et al. 2015, "Human-level control through deep
reinforcement learning" (Nature 518)."""
SMALL = Convolutions(((32, 4, 2), (64, 3, 1)), 256)
"""For images of 8 to 35 pixels on their shorter side. Our own choice; smaller ones are flattened."""


def image_shape(shape: tuple[int, ...]) -> tuple[int, int, int]:
    """Returns height, width and channels of an image of 3 axes, or of a stack of images of 4.

    The channels come first where the first axis is the shortest, else last, as Stable-Baselines3 has it. Frames of a
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


def convolutions(leaf: Leaf) -> Convolutions | None:
    """Returns the convolutions that an observation goes through, None if it is no image or too small for any."""
    if leaf.dtype != "uint8" or len(leaf.shape) not in (3, 4):
        return None
    side = min(image_shape(leaf.shape)[:2])
    return NATURE if side >= 36 else SMALL if side >= 8 else None


class CNN(eqx.Module):
    """Pixels to features: convolutions and one linear layer, each followed by a relu."""

    layers: tuple[Convolution, ...]
    linear: Linear

    def __init__(self, key: Array, shape: tuple[int, ...], kind: Convolutions) -> None:
        *layer_keys, linear_key = jax.random.split(key, len(kind.layers) + 1)
        height, width, channels = image_shape(shape)
        layers = []
        for layer_key, (n_filters, kernel, stride) in zip(layer_keys, kind.layers, strict=True):
            layers.append(Convolution(layer_key, channels, n_filters, kernel, stride))
            height, width, channels = (height - kernel) // stride + 1, (width - kernel) // stride + 1, n_filters
        self.layers = tuple(layers)
        self.linear = Linear(linear_key, height * width * channels, kind.n_outputs)

    def __call__(self, x: Array) -> Array:
        """Maps images ``(batch, ...)`` of 0 to 255 to features ``(batch, n_outputs)``."""
        x = channels_last(x).astype(jnp.float32) / 255.0
        for layer in self.layers:
            x = jax.nn.relu(layer(x))
        return jax.nn.relu(self.linear(x.reshape(x.shape[0], -1)))


class Encoder(eqx.Module):
    """Turns an observation of any structure into one feature vector, leaf by leaf; every image has a CNN of its own."""

    leaves: tuple[Leaf, ...] = eqx.field(static=True)
    images: tuple[CNN, ...]
    """In the order of the leaves that are images."""

    def __init__(self, leaves: tuple[Leaf, ...], key: Array | None = None) -> None:
        """Builds an encoder of these leaves; only images need the key.

        Raises:
            TypeError: if there are images and no key.
        """
        self.leaves = leaves
        images: list[CNN] = []
        for leaf in leaves:
            if (kind := convolutions(leaf)) is not None:
                if key is None:
                    raise TypeError(
                        "Encoder(leaves, key): the encoder of an image has weights and needs a key to draw them"
                    )
                images.append(CNN(jax.random.fold_in(key, len(images)), leaf.shape, kind))
        self.images = tuple(images)

    @property
    def n_features(self) -> int:
        """Length of the feature vector."""
        return sum(n_features(leaf) for leaf in self.leaves)

    def __call__(self, obs: PyTree) -> Array:
        """Maps observations ``(batch, ...)`` to features ``(batch, n_features)``."""
        images = iter(self.images)
        parts = [
            encode_leaf(leaf, x) if convolutions(leaf) is None else next(images)(x)
            for leaf, x in zip(self.leaves, jax.tree.leaves(obs), strict=True)
        ]
        return parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=-1)


def n_features(leaf: Leaf) -> int:
    """Returns how many features an observation leaf becomes."""
    kind = convolutions(leaf)
    return leaf.n_features if kind is None else kind.n_outputs


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


Torso = MLP | Branches | SimBa | Any
"""Hidden layers: rejeu's own, or any module of the user's."""


def make_torso(
    key: Array, n_features: int, action_dim: int | None, widths: Sequence[int], shape: PolicyConfig
) -> tuple[Torso, int]:
    """Returns the hidden layers that ``shape`` asks for, and how many numbers come out of them.

    Args:
        key: draws their weights.
        n_features: length of the encoded observation.
        action_dim: of a critic that is given actions; None for a network without.
        widths: what ``shape.actor_widths`` or ``shape.critic_widths`` said.
        shape: which kind of torso.
    """
    n_inputs = n_features + (action_dim or 0)
    if shape.torso is not None:
        torso = own_torso(shape.torso, key, n_inputs)
        return torso, torso.n_outputs
    if shape.has_branches:
        branches = Branches(key, n_features, action_dim, widths, shape)
        joined = (n_features, *shape.state_layers)[-1]
        joined += 0 if action_dim is None else (action_dim, *shape.action_layers)[-1]
        return branches, (joined, *shape.common_layers, *widths)[-1]
    if shape.architecture == "simba":
        return SimBa(key, n_inputs, widths, shape.activation_fn), widths[-1]
    return MLP(key, n_inputs, widths, shape.activation_fn, shape.layer_norm), (n_inputs, *widths)[-1]


def own_torso(make: Callable[[Array, int], Any], key: Array, n_inputs: int) -> Any:
    """Returns the user's module, checked: all that it holds must be learnable or static.

    Raises:
        TypeError: if it is no ``equinox.Module``, has no ``n_outputs``, or has leaves that are no float32 arrays.
    """
    torso = make(key, n_inputs)
    name = getattr(make, "__name__", repr(make))
    if not isinstance(torso, eqx.Module):
        raise TypeError(f"torso={name} made {type(torso).__name__}, expected an equinox.Module")
    n_outputs = getattr(torso, "n_outputs", None)
    if not isinstance(n_outputs, int) or n_outputs < 1:
        raise TypeError(f"torso={name} needs the attribute n_outputs: int = eqx.field(static=True), got {n_outputs!r}")
    for path, leaf in jax.tree_util.tree_leaves_with_path(torso):
        if not isinstance(leaf, jax.Array) or leaf.dtype != jnp.float32:
            kind = f"array of {leaf.dtype}" if isinstance(leaf, jax.Array) else type(leaf).__name__
            where = jax.tree_util.keystr(path, simple=True, separator=".")
            raise TypeError(
                f"torso={name} holds {where}, which is of type {kind} and cannot be learnt; declare that field "
                "eqx.field(static=True)"
            )
    return torso


class Actor(eqx.Module):
    """Observation to the parameters of an action: encoder, hidden layers, one linear head."""

    encoder: Encoder
    torso: Torso
    head: Linear

    def __init__(
        self, key: Array, leaves: tuple[Leaf, ...], n_outputs: int, widths: Sequence[int], shape: PolicyConfig
    ):
        torso_key, head_key = jax.random.split(key)
        self.encoder = Encoder(leaves, jax.random.fold_in(key, 2))
        self.torso, n_hidden = make_torso(torso_key, self.encoder.n_features, None, widths, shape)
        self.head = Linear(head_key, n_hidden, n_outputs)

    def __call__(self, obs: PyTree) -> Array:
        """Maps observations ``(batch, ...)`` to ``(batch, n_outputs)``."""
        return self.head(self.torso(self.encoder(obs)))


class Critic(eqx.Module):
    """Observation and continuous action to action values: encoder, hidden layers, one linear head."""

    encoder: Encoder
    torso: Torso
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
        self.encoder = Encoder(leaves, jax.random.fold_in(key, 2))
        self.torso, n_hidden = make_torso(torso_key, self.encoder.n_features, action_dim, widths, shape)
        self.head = Linear(head_key, n_hidden, n_outputs)

    def __call__(self, obs: PyTree, action: Array) -> Array:
        """Maps observations ``(batch, ...)`` and actions ``(batch, action_dim)`` to ``(batch, n_outputs)``."""
        features = self.encoder(obs)
        if isinstance(self.torso, Branches):
            return self.head(self.torso(features, action))
        return self.head(self.torso(jnp.concatenate([features, action], axis=-1)))


def action_values(critics: Critic, obs: PyTree, action: Array) -> Array:
    """Returns the value that each of the stacked critics gives, ``(n_critics, batch)``."""
    return jax.vmap(lambda critic: critic(obs, action)[:, 0])(critics)
