"""Several devices that share the runs of one program: each computes an equal number of them, apart from the others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from rejeu.core import PyTree
from rejeu.xla import for_runs

T = TypeVar("T")
RUNS = "runs"
"""Name of the axis of runs."""
MOST_ON_CPU = 8
"""Runs that a CPU device computes at once at most: the layers of more do not fit into the cache of a core."""


def mesh_of(n_runs: int, devices: Sequence[jax.Device]) -> Mesh | None:
    """Returns the devices that share so many runs; None if one computes all."""
    used = np.array(devices[:n_runs])
    return Mesh(used, (RUNS,)) if len(used) > 1 else None


def filled(runs: Sequence[T], size: int) -> list[T]:
    """Returns the runs, and the first one again until there are ``size``.

    What the additional ones compute is not used. It takes no time, because other devices are busy as long.

    >>> filled("abc", 4)
    ['a', 'b', 'c', 'a']
    """
    return [*runs, *[runs[0]] * (size - len(runs))]


def group_size(n_runs: int, devices: Sequence[jax.Device]) -> int:
    """Returns how many runs are computed at once: a multiple of the number of devices that share them."""
    n_devices = min(max(len(devices), 1), n_runs)
    of_each = -(-n_runs // n_devices)
    is_cpu = not devices or devices[0].platform == "cpu"
    n_groups = -(-of_each // MOST_ON_CPU) if is_cpu else 1
    return n_devices * -(-of_each // n_groups)


def spread(make: Callable[[T], PyTree], runs: Sequence[T], mesh: Mesh | None) -> PyTree:
    """Returns the trees that ``make`` returns for the runs as one, whose leaves have a leading axis of runs.

    The number of runs must be a multiple of the number of devices, each of which gets its share.
    """
    if mesh is None:
        return stacked([make(run) for run in runs])
    size, sharding = len(runs) // mesh.size, NamedSharding(mesh, PartitionSpec(RUNS))
    shares = [
        jax.device_put(stacked([make(run) for run in runs[i * size : (i + 1) * size]]), device)
        for i, device in enumerate(mesh.devices)
    ]

    def joined(*parts: jax.Array) -> jax.Array:
        return jax.make_array_from_single_device_arrays((len(runs), *parts[0].shape[1:]), sharding, parts)

    return jax.tree.map(joined, *shares)


def over_runs(
    function: Callable[..., Any], n: int, mesh: Mesh | None, in_axes: Any, out_axes: Any
) -> Callable[..., Any]:
    """Returns ``function`` of one run for all: ``jax.vmap``, and each device computes its share.

    Args:
        function: of one run.
        n: the number of runs; a single one has no axis.
        mesh: the devices.
        in_axes: 0 for arguments with an axis of runs, None for those without one; trees as for ``jax.vmap``.
        out_axes: likewise of the results.
    """
    if n == 1:
        return function
    mapped = jax.vmap(for_runs(function, n if mesh is None else n // mesh.size), in_axes, out_axes)
    if mesh is None:
        return mapped
    spec = lambda axis: PartitionSpec() if axis is None else PartitionSpec(RUNS)  # noqa: E731
    specs = lambda axes: jax.tree.map(spec, axes, is_leaf=lambda axis: axis is None)  # noqa: E731
    return jax.shard_map(mapped, mesh=mesh, in_specs=specs(in_axes), out_specs=specs(out_axes), check_vma=False)


def stacked(trees: Sequence[PyTree]) -> PyTree:
    """Returns trees of equal structure as one on the device, whose leaves have a leading axis."""

    def joined(*leaves: Any) -> jax.Array:
        on_host = all(isinstance(leaf, np.ndarray) for leaf in leaves)
        return jnp.array(np.stack(leaves)) if on_host else jnp.stack(leaves)

    return jax.tree.map(joined, *trees)


def unstacked(tree: PyTree, n: int) -> list[PyTree]:
    """Returns the ``n`` trees of which :func:`stacked` made one; a single one has no leading axis."""
    return [tree] if n == 1 else [jax.tree.map(lambda leaf, i=i: leaf[i], tree) for i in range(n)]


def copies(tree: PyTree) -> PyTree:
    """Returns copies of arrays on the host."""
    return jax.tree.map(np.array, jax.device_get(tree))
