"""Categorical distributions of the return: probabilities of fixed, equally spaced values, the atoms.

Source: Bellemare et al. 2017, "A Distributional Perspective on Reinforcement Learning" (arXiv 1707.06887). With atoms ``z_i``
from ``v_min`` to ``v_max`` at the distance ``dz``, predicted probabilities ``p_i``, and a target distribution of the values
``x_j`` with the probabilities ``q_j``::

    E   = sum_i p_i z_i
    m_i = sum_j [1 - |[x_j]_v_min^v_max - z_i| / dz]_0^1 q_j            equation 7
    J   = -sum_i m_i log p_i                                            the cross-entropy, algorithm 1
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from rejeu.core import xla


def make_atoms(v_min: float, v_max: float, n_atoms: int) -> Array:
    """Returns the atoms, ``(n_atoms,)``; two or more.

    >>> make_atoms(-1.0, 1.0, 3).tolist()
    [-1.0, 0.0, 1.0]
    """
    return jnp.linspace(v_min, v_max, n_atoms, dtype=jnp.float32)


def mean_of(logits: Array, atoms: Array) -> Array:
    """Returns the mean of each distribution, ``(...)`` for logits ``(..., n_atoms)``.

    >>> float(mean_of(jnp.zeros(3), jnp.array([0.0, 1.0, 5.0])))
    2.0
    """
    return jnp.sum(jax.nn.softmax(logits, axis=-1) * atoms.reshape(*[1] * (logits.ndim - 1), -1), axis=-1)


def project(values: Array, probabilities: Array, atoms: Array) -> Array:
    """Returns the distribution on the atoms that is nearest to another: each value gives its probability to its neighbors.

    The mean stays the same if all values are within the atoms; values beyond count as the first or the last atom.

    Args:
        values: of the other distribution, ``(..., n)``.
        probabilities: of these values, ``(..., n)``, which sum to 1 along the last axis.
        atoms: of :func:`make_atoms`, ``(n_atoms,)``.

    Returns:
        ``(..., n_atoms)``.

    >>> project(jnp.array([0.25, 9.0]), jnp.array([0.8, 0.2]), make_atoms(-1.0, 1.0, 3)).tolist()
    [0.0, 0.6000000238418579, 0.4000000059604645]
    """
    positions = (jnp.clip(values, atoms[0], atoms[-1]) - atoms[0]) / (atoms[1] - atoms[0])
    return (_scattered if xla.platform() == "cpu" else _spread)(positions, probabilities, atoms.shape[0])


def _spread(positions: Array, probabilities: Array, n_atoms: int) -> Array:
    """Returns the projection of values at ``positions`` ``(..., n)``, from 0 to ``n_atoms - 1``, by equation 7.

    On a GPU the order of a sum of scattered numbers is not fixed, and runs would not be reproducible.
    """
    atom = jnp.arange(n_atoms, dtype=jnp.float32).reshape(*[1] * (positions.ndim - 1), -1, 1)
    share = jnp.maximum(1.0 - jnp.abs(positions[..., None, :] - atom), 0.0)
    return jnp.sum(share * probabilities[..., None, :], axis=-1)


def _scattered(positions: Array, probabilities: Array, n_atoms: int) -> Array:
    """Returns the result of :func:`_spread` by adding to two atoms: for 101 atoms, a hundred times as fast on a CPU."""
    shape, n = positions.shape, positions.shape[-1]
    positions, probabilities = positions.reshape(-1, n), probabilities.reshape(-1, n)
    lower = jnp.clip(jnp.floor(positions), 0.0, n_atoms - 2.0)
    upper_share = positions - lower
    rows, lower = jnp.arange(positions.shape[0])[:, None], lower.astype(jnp.int32)
    sums = jnp.zeros((positions.shape[0], n_atoms), jnp.float32)
    lower_sums = sums.at[rows, lower].add(probabilities * (1.0 - upper_share))
    return lower_sums.at[rows, lower + 1].add(probabilities * upper_share).reshape(*shape[:-1], n_atoms)


def cross_entropy(logits: Array, target: Array) -> Array:
    """Returns ``-sum_i m_i log p_i`` of predicted logits and target probabilities, ``(...)`` for ``(..., n_atoms)``.

    The target may lack leading axes of the logits, such as that of several critics.

    >>> round(float(cross_entropy(jnp.zeros(4), jnp.array([0.0, 0.5, 0.5, 0.0]))), 4)
    1.3863
    """
    return -jnp.sum(jnp.broadcast_to(target, logits.shape) * jax.nn.log_softmax(logits, axis=-1), axis=-1)
