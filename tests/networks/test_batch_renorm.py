"""Batch renormalisation against float64 NumPy, written from Ioffe 2017 (arXiv 1702.03275), algorithm 1."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rejeu.core.spaces import Leaf
from rejeu.networks.batch_renorm import BatchRenorm, RenormalizedMLP, RenormalizedNetwork, in_training, with_statistics

WIDTH, BATCH = 3, 6


class NumpyRenorm:
    """Algorithm 1 with the running variance in place of the running deviation, r <= 3, |d| <= 5, 1 % of movement."""

    def __init__(self, layer):
        self.scale, self.offset = np.float64(layer.scale), np.float64(layer.offset)
        self.mean, self.variance = np.float64(layer.mean), np.float64(layer.variance)
        self.n, self.warm_up = int(layer.n_batches), layer.warm_up
        self.r, self.d = 1.0, 0.0

    def train(self, x):
        m_b, v_b = x.mean(axis=0), x.var(axis=0)
        s_b, s = np.sqrt(v_b + 1e-3), np.sqrt(self.variance + 1e-3)
        self.r, self.d = np.ones(len(m_b)), np.zeros(len(m_b))
        if self.n >= self.warm_up:
            self.r, self.d = np.clip(s_b / s, 1 / 3, 3), np.clip((m_b - self.mean) / s, -5, 5)
        normal = (x - m_b) / s_b * self.r + self.d
        self.mean, self.variance = 0.99 * self.mean + 0.01 * m_b, 0.99 * self.variance + 0.01 * v_b
        self.n += 1
        return self.scale * normal + self.offset

    def infer(self, x):
        return self.scale * (x - self.mean) / np.sqrt(self.variance + 1e-3) + self.offset


def layer_with(warm_up=0, **arrays):
    layer = BatchRenorm(WIDTH, warm_up)
    for name, values in arrays.items():
        layer = eqx.tree_at(lambda norm, name=name: getattr(norm, name), layer, jnp.array(values, jnp.float32))
    return layer


def batch(seed, mean=0.0, deviation=1.0):
    x = np.random.default_rng(seed).normal(size=(BATCH, WIDTH))
    return jnp.array(mean + deviation * x, jnp.float32)


@pytest.mark.usefixtures("strict_dtypes")
def test_training_equals_numpy_over_warm_up_and_after():
    layer = layer_with(warm_up=3, scale=[0.5, 1.0, 2.0], offset=[0.1, 0.0, -1.0])
    reference = NumpyRenorm(layer)
    corrected = []
    for step in range(8):
        x = batch(step, mean=np.array([0.0, 2.0, -3.0]), deviation=np.array([1.0, 0.5, 2.0]))
        y, layer = layer.train(x)
        np.testing.assert_allclose(y, reference.train(np.float64(x)), atol=2e-5)
        np.testing.assert_allclose(layer.mean, reference.mean, atol=1e-6)
        np.testing.assert_allclose(layer.variance, reference.variance, atol=1e-6)
        corrected.append(bool((reference.r != 1).any()))
    assert corrected == [False] * 3 + [True] * 5
    assert float(layer.n_batches) == 8


@pytest.mark.usefixtures("strict_dtypes")
def test_use_equals_numpy_and_leaves_each_row_to_itself():
    layer = layer_with(mean=[1.0, -2.0, 0.0], variance=[4.0, 0.25, 1.0], scale=[0.5, 1.0, 2.0], offset=[0.1, 0.0, -1.0])
    x = batch(0)
    np.testing.assert_allclose(layer(x), NumpyRenorm(layer).infer(np.float64(x)), atol=1e-5)
    np.testing.assert_allclose(layer(x)[:1], layer(x[:1]), atol=1e-6)


@pytest.mark.parametrize(("deviation", "r"), [(100.0, 3.0), (0.001, 1 / 3)])
def test_the_ratio_of_deviations_is_clipped(deviation, r):
    """With a running deviation of sqrt(1.001) and no difference of means, the output's deviation is r s_B0 / s_B."""
    x = batch(0, deviation=deviation)
    x = x - jnp.mean(x, axis=0)[None]
    y, _ = layer_with(warm_up=0).train(x)
    variance = np.var(np.float64(x), axis=0)
    np.testing.assert_allclose(np.std(y, axis=0), r * np.sqrt(variance / (variance + 1e-3)), rtol=1e-3)


@pytest.mark.parametrize(("mean", "d"), [(1000.0, 5.0), (-1000.0, -5.0)])
def test_the_difference_of_means_is_clipped(mean, d):
    y, _ = layer_with(warm_up=0).train(batch(0, mean=mean))
    np.testing.assert_allclose(np.mean(y, axis=0), d, atol=1e-3)


@pytest.mark.parametrize("warm_up", [0, 5])
def test_the_gradient_equals_finite_differences_with_r_and_d_held(warm_up):
    """Through the batch's own mean and deviation, not through r, d or the running statistics."""
    layer = layer_with(warm_up, mean=[0.5, 0.0, -0.5], variance=[2.0, 1.0, 0.5], scale=[0.5, 1.0, 2.0])
    x, direction = batch(1), np.random.default_rng(2).normal(size=(BATCH, WIDTH))
    gradient = jax.grad(lambda x: jnp.sum(layer.train(x)[0] * jnp.array(direction, jnp.float32)))(x)
    reference = NumpyRenorm(layer)
    reference.train(np.float64(x))

    def loss(x):
        normal = (x - x.mean(axis=0)) / np.sqrt(x.var(axis=0) + 1e-3) * reference.r + reference.d
        return np.sum((reference.scale * normal + reference.offset) * direction)

    expected = np.zeros((BATCH, WIDTH))
    for index in np.ndindex(expected.shape):
        step = np.zeros((BATCH, WIDTH))
        step[index] = 1e-6
        expected[index] = (loss(np.float64(x) + step) - loss(np.float64(x) - step)) / 2e-6
    np.testing.assert_allclose(gradient, expected, atol=1e-4)


@pytest.mark.parametrize("mode", ["train", "use"])
def test_running_statistics_get_no_gradient_and_scale_and_offset_do(mode):
    layer = layer_with(warm_up=0, mean=[0.5, 0.0, -0.5])
    x = batch(0)
    output = (lambda norm: norm.train(x)[0]) if mode == "train" else (lambda norm: norm(x))
    gradient = jax.grad(lambda norm: jnp.sum(jnp.square(output(norm))))(layer)
    for name in ("mean", "variance", "n_batches"):
        np.testing.assert_array_equal(getattr(gradient, name), 0.0)
    for name in ("scale", "offset"):
        assert (np.asarray(getattr(gradient, name)) != 0).all()


def numpy_torso(torso, norms, x, method):
    """Layers and renormalisations in turn: norm, linear, relu, norm, linear, relu, norm."""
    x = getattr(norms[0], method)(np.float64(x))
    for layer, norm in zip(torso.layers, norms[1:], strict=True):
        x = getattr(norm, method)(np.maximum(x @ np.float64(layer.weight) + np.float64(layer.bias), 0.0))
    return x


@pytest.mark.usefixtures("strict_dtypes")
def test_a_torso_renormalises_its_input_and_each_layer_after_the_nonlinearity():
    torso = RenormalizedMLP(jax.random.PRNGKey(0), WIDTH, (5, 4), "relu", warm_up=1)
    norms = [NumpyRenorm(norm) for norm in torso.norms]
    for seed in range(3):
        x = batch(seed, mean=2.0)
        y, torso = in_training(torso, lambda torso: torso(x))  # noqa: B023
        np.testing.assert_allclose(y, numpy_torso(torso, norms, x, "train"), atol=1e-4)
    np.testing.assert_allclose(torso(x), numpy_torso(torso, norms, x, "infer"), atol=1e-4)


def test_with_statistics_takes_the_statistics_of_one_network_and_the_weights_of_the_other():
    leaf = Leaf("", "continuous", (WIDTH,), "float32")
    torso = lambda key, n_inputs: RenormalizedMLP(key, n_inputs, (4,), "relu", warm_up=0)  # noqa: E731
    one, other = (RenormalizedNetwork(jax.random.PRNGKey(seed), (leaf,), None, 2, torso) for seed in (0, 1))
    _, other = in_training(other, lambda other: other(batch(0, mean=3.0)))
    joined = with_statistics(one, other)
    for own, norm, trained in zip(one.torso.norms, joined.torso.norms, other.torso.norms, strict=True):
        for name in ("mean", "variance", "n_batches"):
            np.testing.assert_array_equal(getattr(norm, name), getattr(trained, name))
        np.testing.assert_array_equal(norm.scale, own.scale)
    np.testing.assert_array_equal(joined.torso.layers[0].weight, one.torso.layers[0].weight)
    np.testing.assert_array_equal(joined.head.weight, one.head.weight)
    assert (joined.torso.norms[0].mean != one.torso.norms[0].mean).all()
