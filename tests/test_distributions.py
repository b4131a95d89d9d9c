"""Densities against float64 SciPy and against numerical integration."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from rejeu.distributions import Normal, TanhNormal, log_tanh_slope

pytestmark = pytest.mark.usefixtures("strict_dtypes")


def logistic_form(u: np.ndarray) -> np.ndarray:
    """log(1 - tanh(u)^2) = log(4 e^{2u} / (1 + e^{2u})^2) = log 4 - 2 |u| - 2 log1p(e^{-2 |u|}), in float64."""
    u = np.abs(np.asarray(u, np.float64))
    return np.log(4.0) - 2.0 * u - 2.0 * np.log1p(np.exp(-2.0 * u))


def test_normal_log_prob_equals_scipy():
    rng = np.random.default_rng(0)
    mean, log_std, value = rng.normal(size=(3, 7, 4))
    expected = stats.norm.logpdf(value, mean, np.exp(log_std)).sum(axis=1)
    given = Normal(jnp.float32(mean), jnp.float32(log_std)).log_prob(jnp.float32(value))
    np.testing.assert_allclose(given, expected, rtol=2e-5)


def test_normal_entropy_equals_scipy():
    log_std = np.array([[-1.0, 0.5, 2.0]])
    expected = stats.norm.entropy(0.0, np.exp(log_std)).sum(axis=1)
    np.testing.assert_allclose(Normal(jnp.zeros((1, 3)), jnp.float32(log_std)).entropy(), expected, rtol=1e-6)


def test_normal_entropy_counts_every_dimension_of_a_shared_log_std():
    shared = Normal(jnp.zeros((5, 3)), jnp.full((1, 1), 0.7, jnp.float32)).entropy()
    np.testing.assert_allclose(shared, np.full(5, 3 * stats.norm.entropy(0.0, np.exp(0.7))), rtol=1e-6)


def test_normal_samples_have_the_mean_and_deviation():
    n = 20_000
    normal = Normal(jnp.broadcast_to(jnp.array([1.0, -2.0]), (n, 2)), jnp.log(jnp.array([[0.5, 3.0]])))
    sample = np.asarray(normal.sample(jax.random.PRNGKey(0)))
    # Standard errors are sigma / sqrt(n) and about sigma / sqrt(2 n); five of them are allowed.
    sigma = np.array([0.5, 3.0])
    assert (np.abs(sample.mean(axis=0) - [1.0, -2.0]) < 5 * sigma / np.sqrt(n)).all()
    assert (np.abs(sample.std(axis=0) - sigma) < 5 * sigma / np.sqrt(2 * n)).all()


def test_mode_maximises_the_density():
    mean, log_std = jnp.array([[0.3, -1.2]]), jnp.array([[-0.5, 0.2]])
    normal = Normal(mean, log_std)
    at_mode = float(normal.log_prob(normal.mode())[0])
    for shift in ([0.1, 0.0], [-0.1, 0.0], [0.0, 0.1], [0.0, -0.1]):
        assert float(normal.log_prob(normal.mode() + jnp.array([shift]))[0]) < at_mode


def test_tanh_mode_is_the_squashed_mean():
    mean = np.array([[0.3, -4.0]])
    np.testing.assert_allclose(TanhNormal(jnp.float32(mean), jnp.zeros((1, 2))).mode(), np.tanh(mean), rtol=1e-6)


@pytest.mark.parametrize("scale", [0.1, 1.0, 5.0, 20.0, 80.0])
def test_log_slope_of_tanh_is_exact_also_where_it_saturates(scale):
    u = scale * np.linspace(-1.0, 1.0, 41, dtype=np.float32)
    np.testing.assert_allclose(log_tanh_slope(jnp.array(u)), logistic_form(u), rtol=2e-6, atol=2e-7 * max(scale, 1.0))


@pytest.mark.parametrize("mean", [0.0, -1.5, 9.0, -20.0])
def test_tanh_normal_log_prob_equals_float64(mean):
    """The sample's own noise is recovered from the key; 9 and -20 lie where float32 tanh is exactly 1 or -1."""
    key = jax.random.PRNGKey(3)
    means = np.full((6, 2), mean)
    log_std = np.linspace(-3.0, 1.0, 12).reshape(6, 2)
    action, log_prob = TanhNormal(jnp.float32(means), jnp.float32(log_std)).sample_and_log_prob(key)
    noise = np.asarray(jax.random.normal(key, (6, 2), jnp.float32), np.float64)
    u = means + np.exp(log_std) * noise
    expected = (stats.norm.logpdf(noise) - log_std - logistic_form(u)).sum(axis=1)
    np.testing.assert_allclose(log_prob, expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(action, np.tanh(u), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(("mean", "log_std"), [(0.0, 0.0), (1.0, -0.5), (-2.0, 0.3)])
def test_tanh_normal_density_integrates_to_one(mean, log_std):
    """The density of a = tanh(u) is N(u) / (1 - a^2); it is integrated over a, as a density of actions must be."""

    u = np.linspace(-12.0, 12.0, 4001)
    action = np.tanh(u)
    normal = Normal(jnp.full((len(u), 1), mean, jnp.float32), jnp.full((1, 1), log_std, jnp.float32))
    value = jnp.array(u[:, None], jnp.float32)
    density = np.exp(np.asarray(normal.log_prob(value) - jnp.sum(log_tanh_slope(value), axis=-1), np.float64))
    total = integrate.trapezoid(density, action)
    assert total == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("u", [20.0, -20.0, 0.0])
def test_log_prob_gradient_is_finite_and_right_where_tanh_saturates(u):
    """d/du log(1 - tanh(u)^2) = -2 tanh(u)."""
    gradient = jax.grad(lambda x: log_tanh_slope(x))(jnp.float32(u))
    assert float(gradient) == pytest.approx(-2.0 * np.tanh(u), abs=1e-6)


@pytest.mark.parametrize("mean", [20.0, -20.0])
def test_gradient_of_a_saturated_sample_is_finite(mean):
    """With std 1 the log-density's derivative by the mean is 2 tanh(u): the Gaussian part does not depend on it."""

    def log_prob(m):
        return jnp.sum(TanhNormal(m, jnp.zeros((1, 1))).sample_and_log_prob(jax.random.PRNGKey(0))[1])

    gradient = jax.grad(log_prob)(jnp.array([[mean]]))
    np.testing.assert_allclose(gradient, [[2.0 * np.sign(mean)]], atol=1e-6)


def test_samples_stay_within_the_bounds_for_extreme_parameters():
    sample = TanhNormal(jnp.array([[50.0, -50.0]]), jnp.array([[2.0, 2.0]])).sample(jax.random.PRNGKey(0))
    assert (np.abs(sample) <= 1.0).all()
