"""Layers with noise on their weights against the definition of factorized noise."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rejeu.core.spaces import Leaf
from rejeu.networks import Network, PolicyConfig
from rejeu.networks.noisy import NoisyLinear, drawn, noisy

N_INPUTS, N_OUTPUTS = 3, 4
LEAVES = (Leaf("", "continuous", (N_INPUTS,), "float32"),)


def network_of():
    return Network(jax.random.PRNGKey(0), LEAVES, N_OUTPUTS, (5,), PolicyConfig())


def layer_of():
    layer = noisy(network_of()).head
    assert isinstance(layer, NoisyLinear)
    return layer


def test_means_are_those_of_the_network_and_scales_those_of_the_paper():
    plain, made = network_of(), noisy(network_of())
    np.testing.assert_array_equal(made.head.weight, plain.head.weight)
    np.testing.assert_array_equal(made.torso.layers[0].bias, plain.torso.layers[0].bias)
    for layer, n_inputs in ((made.torso.layers[0], N_INPUTS), (made.head, 5)):
        np.testing.assert_allclose(layer.weight_scale, 0.5 / np.sqrt(n_inputs), rtol=1e-6)
        np.testing.assert_allclose(layer.bias_scale, 0.5 / np.sqrt(n_inputs), rtol=1e-6)
    obs = jnp.ones((2, N_INPUTS))
    np.testing.assert_array_equal(made(obs), plain(obs))
    np.testing.assert_array_equal(drawn(made, None)(obs), plain(obs))


@pytest.mark.usefixtures("strict_dtypes")
def test_noise_of_a_weight_is_the_product_of_those_of_its_input_and_its_output():
    layer = layer_of()
    one = layer.drawn(jax.random.PRNGKey(1))
    of_weights = (np.float64(one.weight) - np.float64(layer.weight)) / np.float64(layer.weight_scale)
    of_outputs = (np.float64(one.bias) - np.float64(layer.bias)) / np.float64(layer.bias_scale)
    of_inputs = of_weights[:, 0] / of_outputs[0]
    np.testing.assert_allclose(of_weights, np.outer(of_inputs, of_outputs), atol=1e-4)
    x = np.float32([[1.0, -2.0, 3.0, 0.5, -1.0]])
    expected = np.float64(x) @ (np.float64(layer.weight) + np.float64(layer.weight_scale) * of_weights) + np.float64(
        one.bias
    )
    np.testing.assert_allclose(one(jnp.asarray(x)), expected, atol=1e-4)


def test_noise_has_the_moments_of_the_root_of_a_normal_number():
    """``f(x)^2 = |x|`` has the mean sqrt(2 / pi), and ``f(x)^4 = x^2`` the mean 1; 40,000 numbers, 5 standard errors."""
    layer = layer_of()
    keys = jax.random.split(jax.random.PRNGKey(2), 10_000)
    biases = jax.vmap(lambda key: layer.drawn(key).bias)(keys)
    noise = (np.float64(biases) - np.float64(layer.bias)) / np.float64(layer.bias_scale)
    n = noise.size
    assert abs(noise.mean()) < 5 * np.sqrt(np.sqrt(2 / np.pi) / n)
    assert abs((noise**2).mean() - np.sqrt(2 / np.pi)) < 5 * np.sqrt((1 - 2 / np.pi) / n)
    assert abs((noise**4).mean() - 1.0) < 5 * np.sqrt(2.0 / n)


def test_layers_draw_independently_and_the_scales_learn():
    made, obs = noisy(network_of()), jnp.ones((2, N_INPUTS))
    one = drawn(made, jax.random.PRNGKey(3))
    of = lambda layer, before: np.asarray((layer.bias - before.bias) / before.bias_scale)  # noqa: E731
    assert not np.isclose(of(one.torso.layers[0], made.torso.layers[0])[:4], of(one.head, made.head)).any()

    def loss(network):
        return jnp.sum(jnp.square(drawn(network, jax.random.PRNGKey(3))(obs)))

    gradient = jax.grad(loss)(made).head.bias_scale
    for i in range(N_OUTPUTS):
        shift = jnp.zeros(N_OUTPUTS).at[i].set(1e-2)
        moved = [
            float(loss(eqx.tree_at(lambda n: n.head.bias_scale, made, made.head.bias_scale + sign * shift)))
            for sign in (1, -1)
        ]
        assert (moved[0] - moved[1]) / 2e-2 == pytest.approx(float(gradient[i]), rel=2e-2, abs=1e-3)
