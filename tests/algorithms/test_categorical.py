"""Categorical distributions of the return against the loops of the paper's algorithm 1, in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rejeu.algorithms.categorical import cross_entropy, make_atoms, mean_of, project
from rejeu.core import xla

V_MIN, V_MAX, N_ATOMS = -3.0, 5.0, 9


def by_loops(values: np.ndarray, probabilities: np.ndarray) -> np.ndarray:
    """Algorithm 1 of arXiv 1707.06887 for one distribution; a value on an atom gives it all of its probability."""
    projected, distance = np.zeros(N_ATOMS), (V_MAX - V_MIN) / (N_ATOMS - 1)
    for value, probability in zip(*np.float64([values, probabilities]), strict=True):
        place = (min(max(value, V_MIN), V_MAX) - V_MIN) / distance
        low, high = int(np.floor(place)), int(np.ceil(place))
        if low == high:
            projected[low] += probability
        else:
            projected[low] += probability * (high - place)
            projected[high] += probability * (place - low)
    return projected


def distributions(shape: tuple[int, ...], n: int, scale: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    weights = rng.gamma(1.0, size=(*shape, n))
    values = (scale * rng.normal(size=(*shape, n)) + 1.0).astype(np.float32)
    values[..., 0] = V_MIN + 2.0  # on an atom
    return values, (weights / weights.sum(axis=-1, keepdims=True)).astype(np.float32)


@pytest.mark.usefixtures("strict_dtypes")
@pytest.mark.parametrize("platform", ["cpu", "gpu"])
@pytest.mark.parametrize("n", [1, 6, 20])
def test_projection_equals_the_loops_of_the_paper_on_every_platform(n, platform, monkeypatch):
    monkeypatch.setattr(xla, "platform", lambda: platform)
    values, probabilities = distributions((2, 4), n, 4.0)
    given = np.asarray(project(jnp.asarray(values), jnp.asarray(probabilities), make_atoms(V_MIN, V_MAX, N_ATOMS)))
    if n > 1:
        assert (values < V_MIN).any()
        assert (values > V_MAX).any()
    for index in np.ndindex(2, 4):
        np.testing.assert_allclose(given[index], by_loops(values[index], probabilities[index]), atol=1e-6)
    np.testing.assert_allclose(given.sum(axis=-1), 1.0, atol=1e-6)


def test_projection_keeps_the_mean_of_values_within_the_atoms():
    values, probabilities = distributions((5,), 7, 0.5)
    assert values.min() > V_MIN
    assert values.max() < V_MAX
    atoms = make_atoms(V_MIN, V_MAX, N_ATOMS)
    given = np.float64(project(jnp.asarray(values), jnp.asarray(probabilities), atoms)) @ np.float64(atoms)
    np.testing.assert_allclose(given, (np.float64(values) * probabilities).sum(axis=-1), atol=1e-5)


def test_atoms_project_to_themselves():
    atoms = make_atoms(V_MIN, V_MAX, N_ATOMS)
    np.testing.assert_allclose(
        project(jnp.tile(atoms, (N_ATOMS, 1)), jnp.eye(N_ATOMS), atoms), np.eye(N_ATOMS), atol=1e-6
    )


@pytest.mark.usefixtures("strict_dtypes")
def test_mean_cross_entropy_and_its_gradient_equal_numpy():
    """The gradient of the cross-entropy by the logits is the predicted minus the target probability."""
    rng = np.random.default_rng(1)
    logits = rng.normal(size=(3, 4, N_ATOMS)).astype(np.float32)
    _, target = distributions((3, 4), N_ATOMS, 1.0, seed=2)
    exponential = np.exp(np.float64(logits))
    probabilities = exponential / exponential.sum(axis=-1, keepdims=True)
    atoms = make_atoms(V_MIN, V_MAX, N_ATOMS)
    np.testing.assert_allclose(
        mean_of(jnp.asarray(logits), atoms), probabilities @ np.linspace(V_MIN, V_MAX, N_ATOMS), atol=1e-5
    )
    expected = -(target * np.log(probabilities)).sum(axis=-1)
    np.testing.assert_allclose(cross_entropy(jnp.asarray(logits), jnp.asarray(target)), expected, rtol=1e-5)
    gradient = jax.grad(lambda x: jnp.sum(cross_entropy(x, jnp.asarray(target))))(jnp.asarray(logits))
    np.testing.assert_allclose(gradient, probabilities - target, atol=1e-6)
