"""The networks of the off-policy algorithms: an encoder, hidden layers and a head each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from rejeu.core import PyTree
from rejeu.networks.encoder import make_encoder
from rejeu.networks.shape import PolicyConfig
from rejeu.networks.torsos import Branches, Torso, make_head, make_torso
from rejeu.spaces import Leaf


class Network(eqx.Module):
    """Maps an observation to a vector, such as the parameters of an action or the values of all actions."""

    encoder: Any
    torso: Torso
    head: Any

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

    encoder: Any
    torso: Torso
    head: Any

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


def action_values(critics: Any, obs: PyTree, action: Array) -> Array:
    """Returns the value that each of the stacked critics gives, ``(n_critics, batch)``."""
    return jax.vmap(lambda critic: critic(obs, action)[:, 0])(critics)


def values_by_critics(state: Any, obs: PyTree, action: Array) -> Array:
    """Returns the same of the critics in the state of an algorithm; for ``Algorithm.action_values``."""
    return action_values(state.critics, obs, action)
