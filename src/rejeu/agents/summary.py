"""The networks of an agent as a table: each layer with the shapes of its arrays and its number of parameters."""

from __future__ import annotations

import dataclasses
import math

import equinox as eqx
import jax
from jax import Array

from rejeu.core import algorithm as core, normalization
from rejeu.core.spaces import Leaf
from rejeu.core.types import PyTree
from rejeu.logs.formatting import aligned


def describe(state: PyTree, leaves: tuple[Leaf, ...]) -> str:
    """Returns a table of all networks of an algorithm's state, and the parts of the observation.

    A layer has the name that its arrays have in a model file. The arrays of several critics have a leading axis.

    Args:
        state: the algorithm's state, of arrays or shapes. Its averaged fields (target networks) are left out.
        leaves: leaves of the observation space.
    """
    if isinstance(state, normalization.State):
        state = state.learner
    rows = []
    for field in dataclasses.fields(state):
        network = getattr(state, field.name)
        if field.name in core.averaged_fields(type(state)) or not isinstance(network, eqx.Module):
            continue
        if jax.tree.leaves(network):
            rows += [(field.name, "", f"{n_parameters(network):,}"), *layers(network)]
    parts = [f"observation {leaf.path}".rstrip() + f": {leaf.kind} {leaf.shape}" for leaf in leaves]
    return "\n".join([aligned(rows), "", *parts])


def layers(network: PyTree) -> list[tuple[str, str, str]]:
    """Returns a row for each layer: its name, the shapes of its arrays, and its number of parameters."""
    by_layer: dict[str, list[tuple[str, Array]]] = {}
    for path, leaf in zip(core.names(network), jax.tree.leaves(network), strict=True):
        layer, _, name = path.rpartition(".")
        by_layer.setdefault(layer, []).append((name, leaf))
    return [
        (f"  {layer}", ", ".join(f"{name} {leaf.shape}" for name, leaf in arrays), f"{n_parameters(arrays):,}")
        for layer, arrays in by_layer.items()
    ]


def n_parameters(network: PyTree) -> int:
    """Returns the number of parameters of a network, over all members of an ensemble."""
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(network) if hasattr(leaf, "shape"))
