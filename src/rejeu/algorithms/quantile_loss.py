"""The quantile Huber loss, by which distributional critics (QR-DQN, IQN, TQC) are trained.

A critic has ``n`` outputs: the quantiles of the return at the fractions ``(i + 1/2) / n``, or at any that are given.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array


def quantile_fractions(n_quantiles: int) -> Array:
    """Returns the fractions of ``n_quantiles`` predicted quantiles, ``(n_quantiles,)`` in (0, 1).

    >>> quantile_fractions(2).tolist()
    [0.25, 0.75]
    """
    return (jnp.arange(n_quantiles, dtype=jnp.float32) + 0.5) / n_quantiles


def quantile_huber_loss(quantiles: Array, targets: Array, kappa: float = 1.0, fractions: Array | None = None) -> Array:
    """Returns the quantile Huber loss of each transition (Dabney et al. 2017, arXiv 1710.10044, equations 9 and 10).

    With ``u = target - quantile`` and Huber's ``L(u)``, which is ``u^2 / 2`` up to ``|u| = kappa`` and
    ``kappa (|u| - kappa / 2)`` beyond, the loss is ``|fraction - 1[u < 0]| L(u)``, averaged over all pairs. The paper
    sums over the predicted quantiles: multiply by their number.

    Args:
        quantiles: predicted, ``(..., batch, n_quantiles)``; leading axes are critics.
        targets: samples of the return to be predicted, ``(batch, n_targets)``, the same for all critics; without gradient.
        kappa: the error at which the loss becomes linear, in the unit of the return.
        fractions: of the quantiles, in [0, 1], ``(batch, n_quantiles)``. None: those of :func:`quantile_fractions`.

    Returns:
        ``(..., batch)``.

    >>> loss = quantile_huber_loss(jnp.array([[0.0, 0.0]]), jnp.array([[0.5, -3.0]]))
    >>> # (0.25 + 0.75) * 0.5^2 / 2 and (0.75 + 0.25) * (3 - 1/2), over four pairs
    >>> loss.tolist()
    [0.65625]
    """
    n_quantiles = quantiles.shape[-1]
    fractions = quantile_fractions(n_quantiles)[None] if fractions is None else fractions
    return _loss(quantiles, targets, fractions.reshape((1,) * (quantiles.ndim - 2) + fractions.shape), kappa)


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def _loss(quantiles: Array, targets: Array, fractions: Array, kappa: float) -> Array:
    return _loss_and_slope(quantiles, targets, fractions, kappa)[0]


def _loss_and_slope(quantiles: Array, targets: Array, fractions: Array, kappa: float) -> tuple[Array, Array]:
    """Returns the loss, ``(..., batch)``, and its derivative by each quantile, shaped as ``quantiles``.

    A scan over the targets, because XLA would write the whole table of pairs to memory several times, which takes about
    fifteen times as long.
    """
    leading, n_quantiles, n_targets = quantiles.ndim - 2, quantiles.shape[-1], targets.shape[-1]

    def add(sums: tuple[Array, Array], target: Array) -> tuple[tuple[Array, Array], None]:
        loss, slope = sums
        error = target - quantiles
        clipped = jnp.clip(error, -kappa, kappa)
        weighted = jnp.where(error < 0, 1.0 - fractions, fractions) * clipped
        return (loss + weighted * (error - 0.5 * clipped), slope - weighted), None

    by_target = targets.T.reshape((n_targets,) + (1,) * leading + (-1, 1))
    nothing = jnp.zeros_like(quantiles)
    (loss, slope), _ = jax.lax.scan(add, (nothing, nothing), by_target, unroll=4)
    n_pairs = n_quantiles * n_targets
    return jnp.sum(loss, axis=-1) / n_pairs, slope / n_pairs


def _forward(
    quantiles: Array, targets: Array, fractions: Array, kappa: float
) -> tuple[Array, tuple[Array, Array, Array]]:
    loss, slope = _loss_and_slope(quantiles, targets, fractions, kappa)
    return loss, (slope, jnp.zeros_like(targets), jnp.zeros_like(fractions))


def _backward(kappa: float, residuals: tuple[Array, Array, Array], gradient: Array) -> tuple[Array, Array, Array]:
    slope, of_targets, of_fractions = residuals
    return gradient[..., None] * slope, of_targets, of_fractions


_loss.defvjp(_forward, _backward)
