"""Quantile regression: what distributional critics (QR-DQN, TQC) are trained by.

A critic gives ``n`` numbers instead of one: the quantiles of the return at the fractions ``(i + 1/2) / n``, which are
the middles of ``n`` equal shares of probability.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array


def quantile_fractions(n_quantiles: int) -> Array:
    """Returns the fractions that ``n_quantiles`` predicted quantiles stand for, ``(n_quantiles,)`` in (0, 1).

    >>> quantile_fractions(2).tolist()
    [0.25, 0.75]
    """
    return (jnp.arange(n_quantiles, dtype=jnp.float32) + 0.5) / n_quantiles


def quantile_huber_loss(quantiles: Array, targets: Array, kappa: float = 1.0) -> Array:
    """Returns the quantile Huber loss of each transition (Dabney et al. 2017, arXiv 1710.10044, equations 9 and 10).

    With ``u = target - quantile`` and Huber's ``L(u)``, which is ``u^2 / 2`` up to ``|u| = kappa`` and
    ``kappa (|u| - kappa / 2)`` beyond, the loss is ``|fraction - 1[u < 0]| L(u)``, averaged over all pairs. The paper
    sums over the predicted quantiles: multiply by their number.

    Args:
        quantiles: predicted, ``(..., batch, n_quantiles)``; leading axes are critics.
        targets: samples of the return to be predicted, ``(batch, n_targets)``, the same for all critics. Not
            differentiated.
        kappa: where the loss turns from quadratic to linear, in the units of the return.

    Returns:
        ``(..., batch)``.

    >>> loss = quantile_huber_loss(jnp.array([[0.0, 0.0]]), jnp.array([[0.5, -3.0]]))
    >>> # (0.25 + 0.75) * 0.5^2 / 2 and (0.75 + 0.25) * (3 - 1/2), over four pairs
    >>> loss.tolist()
    [0.65625]
    """
    targets = jax.lax.stop_gradient(targets)
    targets = targets.reshape((1,) * (quantiles.ndim - 2) + (targets.shape[0], 1, targets.shape[1]))
    error = targets - quantiles[..., None]
    size = jnp.abs(error)
    within = jnp.minimum(size, kappa)
    huber = within * (size - 0.5 * within)
    fractions = quantile_fractions(quantiles.shape[-1]).reshape((1,) * (quantiles.ndim - 1) + (-1, 1))
    share = jnp.where(error < 0, 1.0 - fractions, fractions)
    return jnp.mean(share * huber, axis=(-2, -1))
