"""TQC's quantile Huber loss against loops, what it truncates, and what it learns. Updates: ``test_off_policy_updates``."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rejeu.algorithms import tqc
from rejeu.algorithms.quantile_loss import quantile_huber_loss
from tests.algorithms.references import quantile_huber

BATCH, N_CRITICS = 6, 2


@pytest.mark.parametrize("kappa", [0.1, 1.0, 5.0])
@pytest.mark.usefixtures("strict_dtypes")
def test_quantile_huber_loss_equals_loops_over_all_pairs(kappa):
    rng = np.random.default_rng(0)
    quantiles, targets = 2 * rng.normal(size=(N_CRITICS, BATCH, 5)), 2 * rng.normal(size=(BATCH, 7))
    given = quantile_huber_loss(jnp.array(quantiles, jnp.float32), jnp.array(targets, jnp.float32), kappa)
    expected = [[quantile_huber(quantiles[n, b], targets[b], kappa) for b in range(BATCH)] for n in range(N_CRITICS)]
    np.testing.assert_allclose(given, expected, atol=1e-5)


def test_the_gradient_of_the_quantile_huber_loss_equals_finite_differences_and_the_targets_get_none():
    rng = np.random.default_rng(1)
    quantiles, targets = 2 * rng.normal(size=(1, 4)), 2 * rng.normal(size=(1, 6))
    loss = lambda q, t: jnp.sum(quantile_huber_loss(q, t))  # noqa: E731
    by_quantiles, by_targets = jax.grad(loss, argnums=(0, 1))(jnp.array(quantiles), jnp.array(targets))
    eps = 1e-6 * np.eye(4)
    expected = [
        (quantile_huber(quantiles[0] + e, targets[0]) - quantile_huber(quantiles[0] - e, targets[0])) / 2e-6
        for e in eps
    ]
    np.testing.assert_allclose(by_quantiles[0], expected, atol=1e-5)
    np.testing.assert_array_equal(by_targets, 0.0)


def test_the_table_of_all_pairs_is_never_in_memory():
    loss = lambda q, t: jnp.sum(quantile_huber_loss(q, t))  # noqa: E731
    compiled = jax.jit(jax.value_and_grad(loss)).lower(jnp.zeros((8, 30)), jnp.zeros((8, 40))).compile()
    needed = compiled.memory_analysis().temp_size_in_bytes
    assert needed < 8 * 30 * 40 * 4, needed


def test_the_quantile_huber_loss_is_least_at_the_quantiles_of_the_samples():
    """Two quantiles, at 1/4 and 3/4, of the numbers 0 to 100, with a kappa too small to matter: 25 and 75."""
    samples = jnp.arange(101.0)[None]
    grid = jnp.arange(0.0, 101.0, 5.0)
    lower = [float(quantile_huber_loss(jnp.array([[q, 75.0]]), samples, 1e-3)[0]) for q in grid]
    upper = [float(quantile_huber_loss(jnp.array([[25.0, q]]), samples, 1e-3)[0]) for q in grid]
    assert (float(grid[np.argmin(lower)]), float(grid[np.argmin(upper)])) == (25.0, 75.0)


def test_truncation_is_of_all_quantiles_together_not_of_each_critic():
    """The second critic says nothing below 10: one quantile dropped per critic, and both of its own go."""
    quantiles = jnp.array([[[3.0, 1.0]], [[20.0, 10.0]]])
    np.testing.assert_array_equal(tqc.truncate(quantiles, 2), [[1.0, 3.0]])
