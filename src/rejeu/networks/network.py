"""Hidden layers (a plain stack, branches, SimBa or the user's own), and the networks made of an encoder, these and a head."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, ShapeDtypeStruct

from rejeu.core.algorithm import PyTree, ensemble
from rejeu.core.spaces import Leaf
from rejeu.networks.encoder import make_encoder
from rejeu.networks.layers import ACTIVATIONS, MLP, LayerNorm, Linear, own_module
from rejeu.networks.memory import each, with_memory
from rejeu.networks.shape import PolicyConfig


class Branches(eqx.Module):
    """Separate hidden layers for observation and action, whose outputs are concatenated; see ``docs/networks.md``."""

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
        settings = shape.activation_fn, shape.layer_norm, shape.dropout
        layers = lambda k, n_inputs, sizes: MLP(k, n_inputs, sizes, *settings)  # noqa: E731
        self.state = layers(keys[0], n_features, shape.state_layers)
        self.action = None if action_dim is None else layers(keys[1], action_dim, shape.action_layers)
        n_joined = joined_width(n_features, action_dim, shape)
        self.common = layers(keys[2], n_joined, shape.common_layers)
        self.last = layers(keys[3], (n_joined, *shape.common_layers)[-1], widths)

    def __call__(self, features: Array, action: Array | None = None) -> Array:
        """Maps features ``(batch, n_features)`` and actions ``(batch, action_dim)`` to ``(batch, n_outputs)``."""
        x = self.state(features)
        if self.action is not None:
            assert action is not None
            x = jnp.concatenate([x, self.action(action)], axis=-1)
        return self.last(self.common(x))


def joined_width(n_features: int, action_dim: int | None, shape: PolicyConfig) -> int:
    """Returns the length of the concatenation of the branches; no action branch if ``action_dim`` is None."""
    from_state = (n_features, *shape.state_layers)[-1]
    return from_state if action_dim is None else from_state + (action_dim, *shape.action_layers)[-1]


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
    2410.09754). The paper's running normalization of observations is not included: use ``normalize=True`` if their scales
    differ. Weights are initialized as in all other layers.
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


Torso = MLP | Branches | SimBa | PyTree
"""Hidden layers: rejeu's, or a module of the user's own."""


def make_torso(
    key: Array, n_features: int, action_dim: int | None, widths: Sequence[int], shape: PolicyConfig
) -> tuple[Torso, int]:
    """Returns the hidden layers that ``shape`` describes, and the number of their outputs.

    Args:
        key: for the weights.
        n_features: length of the encoded observation.
        action_dim: of a critic that is given actions; None for a network without.
        widths: what ``shape.actor_widths`` or ``shape.critic_widths`` returned.
        shape: the kind of hidden layers.
    """
    n_inputs = n_features + (action_dim or 0)
    if shape.torso is not None:
        role = f"torso={name_of(shape.torso)}"
        return own_module(role, shape.torso(key, n_inputs), ShapeDtypeStruct((n_inputs,), jnp.float32))
    if shape.has_branches:
        branches = Branches(key, n_features, action_dim, widths, shape)
        return branches, (joined_width(n_features, action_dim, shape), *shape.common_layers, *widths)[-1]
    if shape.architecture == "simba":
        return SimBa(key, n_inputs, widths, shape.activation_fn), widths[-1]
    plain = MLP(key, n_inputs, widths, shape.activation_fn, shape.layer_norm, shape.dropout)
    return plain, (n_inputs, *widths)[-1]


def make_head(key: Array, n_inputs: int, n_outputs: int, shape: PolicyConfig) -> PyTree:
    """Returns the last layer of a network: a linear one, or the module of the user's own.

    Raises:
        TypeError: if the user's module does not map ``n_inputs`` numbers to ``n_outputs``.
    """
    if shape.head is None:
        return Linear(key, n_inputs, n_outputs)
    role = f"head={name_of(shape.head)}"
    example = ShapeDtypeStruct((n_inputs,), jnp.float32)
    head, n = own_module(role, shape.head(key, n_inputs, n_outputs), example)
    if n != n_outputs:
        raise TypeError(f"{role} must have {n_outputs} outputs, got {n}")
    return head


def name_of(function: object) -> str:
    """Returns the name of a function or class for messages."""
    return getattr(function, "__name__", repr(function))


class Network(eqx.Module):
    """Maps an observation to a vector, such as the parameters of an action or the values of all actions."""

    encoder: PyTree
    torso: Torso
    head: PyTree

    def __init__(
        self, key: Array, leaves: tuple[Leaf, ...], n_outputs: int, widths: Sequence[int], shape: PolicyConfig
    ) -> None:
        torso_key, head_key = jax.random.split(key)
        self.encoder = make_encoder(jax.random.fold_in(key, 2), leaves, shape)
        self.torso, n_hidden = make_torso(torso_key, self.encoder.n_features, None, widths, shape)
        self.head = make_head(head_key, n_hidden, n_outputs, shape)

    def __call__(self, obs: PyTree) -> Array:
        """Maps observations ``(batch, ...)`` to ``(batch, n_outputs)``."""
        return self.head(self.torso(self.encoder(obs)))


class QNetwork(eqx.Module):
    """Maps an observation and a continuous action to a value, or to several such as quantiles."""

    encoder: PyTree
    torso: Torso
    head: PyTree

    def __init__(
        self,
        key: Array,
        leaves: tuple[Leaf, ...],
        action_dim: int,
        widths: Sequence[int],
        shape: PolicyConfig,
        n_outputs: int = 1,
    ) -> None:
        torso_key, head_key = jax.random.split(key)
        self.encoder = make_encoder(jax.random.fold_in(key, 2), leaves, shape)
        self.torso, n_hidden = make_torso(torso_key, self.encoder.n_features, action_dim, widths, shape)
        self.head = make_head(head_key, n_hidden, n_outputs, shape)

    def __call__(self, obs: PyTree, action: Array) -> Array:
        """Maps observations ``(batch, ...)`` and actions ``(batch, action_dim)`` to ``(batch, n_outputs)``."""
        features = self.encoder(obs)
        if isinstance(self.torso, Branches):
            return self.head(self.torso(features, action))
        return self.head(self.torso(jnp.concatenate([features, action], axis=-1)))


def action_values(critics: PyTree, obs: PyTree, action: Array) -> Array:
    """Returns the value that each of the stacked critics gives, ``(n_critics, batch)``."""
    return each(critics, obs, lambda critic, obs: critic(obs, action)[:, 0])


def values_by_critics(state: PyTree, obs: PyTree, action: Array) -> Array:
    """Returns the values by the critics in the state of an algorithm; for ``Algorithm.action_values``."""
    return action_values(state.critics, obs, action)


def actor_and_critics(
    inputs: tuple[tuple[Leaf, ...], PolicyConfig],
    n_outputs: int,
    n_critics: int,
    critic_class: type[PyTree],
    *sizes: int,
    critic_shape: PolicyConfig | None = None,
) -> tuple[Callable[[Array], PyTree], Callable[[Array], PyTree]]:
    """Returns functions of a key that build an actor of ``n_outputs``, and ``n_critics`` stacked critics.

    Args:
        inputs: the leaves of observations, and the shape of the networks with its widths.
        n_outputs: of the actor.
        n_critics: number of critics.
        critic_class: class of a critic.
        sizes: its numbers of actions and outputs, as it takes them.
        critic_shape: of the critics, if it is another.
    """
    leaves, shape = inputs

    def actor(key: Array) -> PyTree:
        build = lambda leaves, shape: Network(key, leaves, n_outputs, shape.actor_widths(), shape)  # noqa: E731
        return with_memory(key, leaves, shape, build)

    def critics(key: Array) -> PyTree:
        size, *more = sizes

        def build(leaves: tuple[Leaf, ...], shape: PolicyConfig) -> PyTree:
            critic = lambda key: critic_class(key, leaves, size, shape.critic_widths(), shape, *more)  # noqa: E731
            return ensemble(critic, key, n_critics)

        return with_memory(key, leaves, critic_shape or shape, build, slot=1)

    return actor, critics
