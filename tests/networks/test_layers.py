"""The layers that all networks are made of, against NumPy, and the shapes that users may ask for."""

from __future__ import annotations

import re

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from rejeu import spaces
from rejeu.core import ensemble
from rejeu.networks import ACTIVATIONS, MLP, LayerNorm, Linear, Network, PolicyConfig, product

pytestmark = pytest.mark.usefixtures("strict_dtypes")
KEY = jax.random.PRNGKey(0)


def test_layer_norm_equals_its_definition():
    norm = LayerNorm(4)
    filled = [jnp.array([1.0, 2.0, 3.0, 4.0]), jnp.array([0.0, 0.5, 1.0, -1.0])]
    norm = jax.tree.unflatten(jax.tree.structure(norm), filled)
    x = np.random.default_rng(0).normal(3.0, 2.0, (5, 4))
    mean, variance = x.mean(axis=1, keepdims=True), x.var(axis=1, keepdims=True)
    expected = (x - mean) / np.sqrt(variance + 1e-5) * [1.0, 2.0, 3.0, 4.0] + [0.0, 0.5, 1.0, -1.0]
    np.testing.assert_allclose(norm(jnp.float32(x)), expected, atol=2e-6)


def test_layer_norm_comes_between_the_linear_map_and_the_nonlinearity():
    mlp = MLP(KEY, 3, [4], "relu", layer_norm=True)
    x = jnp.array([[1.0, -2.0, 0.5]])
    np.testing.assert_array_equal(mlp(x), jax.nn.relu(mlp.norms[0](mlp.layers[0](x))))


def test_an_mlp_without_layers_hands_its_input_on():
    x = jnp.array([[1.0, 2.0]])
    np.testing.assert_array_equal(MLP(KEY, 2, [], "relu", layer_norm=False)(x), x)


@pytest.mark.parametrize("n_outputs", [1, 5])
@pytest.mark.parametrize("backend", ["cpu", "gpu"])
@pytest.mark.parametrize("shape", [(6, 4), (3, 6, 4)], ids=["batch", "steps-of-batches"])
def test_the_gradients_of_a_product_equal_numpys(shape, backend, n_outputs, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    draw = lambda i, *s: np.asarray(jax.random.normal(jax.random.PRNGKey(i), s))  # noqa: E731
    x, weight, gradient = draw(0, *shape), draw(1, 4, n_outputs), draw(2, *shape[:-1], n_outputs)
    out, pull_back = jax.vjp(product, x, weight)
    for_x, for_weight = pull_back(gradient)
    np.testing.assert_allclose(out, x @ weight, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(for_x, gradient @ weight.T, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(for_weight, np.tensordot(x, gradient, (range(x.ndim - 1),) * 2), rtol=1e-5, atol=1e-6)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="of XLA on CPUs")
def test_no_gradient_multiplies_by_a_transposed_left_side():
    """Which XLA's library of matrix products does not take; a change of XLA's that undid our own would be seen here."""
    transposed = re.compile(r" dot\(.*lhs_contracting_dims=\{0\}")

    def compiled(multiply):
        loss = lambda weight, x: jnp.sum(jnp.square(jax.nn.relu(multiply(x, weight))))  # noqa: E731
        return jax.jit(jax.grad(loss)).lower(jnp.ones((128, 128)), jnp.ones((128, 128))).compile().as_text()

    assert transposed.search(compiled(jnp.matmul))
    assert not transposed.search(compiled(product))


def test_an_ensemble_takes_the_gradient_of_each_member():
    stack = ensemble(lambda key: Linear(key, 4, 3), KEY, 2)
    x, target = jax.random.normal(KEY, (5, 4)), jnp.ones((5, 3))
    loss = lambda layer: jnp.sum(jnp.square(layer(x) - target))  # noqa: E731
    together = jax.vmap(jax.grad(loss))(stack)
    for i in range(2):
        member = jax.tree.map(lambda leaf, i=i: leaf[i], stack)
        residual = 2 * (np.asarray(x) @ np.asarray(member.weight) + np.asarray(member.bias) - 1)
        np.testing.assert_allclose(together.weight[i], np.asarray(x).T @ residual, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(together.bias[i], residual.sum(axis=0), rtol=1e-4, atol=1e-5)


FORMULAS = {
    "relu": lambda x: np.maximum(x, 0),
    "tanh": np.tanh,
    "elu": lambda x: np.where(x > 0, x, np.expm1(x)),
    "gelu": lambda x: 0.5 * x * (1 + np.tanh(np.sqrt(2 / np.pi) * (x + 0.044715 * x**3))),
    "silu": lambda x: x * special.expit(x),
    "leaky_relu": lambda x: np.where(x > 0, x, 0.01 * x),
    "leakyrelu": lambda x: np.where(x > 0, x, 0.01 * x),
    "sigmoid": special.expit,
}


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_activations_equal_their_formulas(name):
    x = np.linspace(-4, 4, 33)
    np.testing.assert_allclose(ACTIVATIONS[name](jnp.float32(x)), FORMULAS[name](x), atol=1e-6)


def test_a_row_of_a_batch_is_computed_as_if_alone():
    leaves = spaces.leaves(gym.spaces.Box(-1.0, 1.0, (3,)))
    actor = Network(KEY, leaves, 2, [8], PolicyConfig(layer_norm=True))
    x = jax.random.normal(KEY, (5, 3))
    np.testing.assert_allclose(actor(x)[2:3], actor(x[2:3]), atol=1e-6)


def test_the_members_of_an_ensemble_start_different():
    stack = ensemble(lambda key: Linear(key, 3, 2), KEY, 4)
    assert stack.weight.shape == (4, 3, 2)
    assert len({np.asarray(weight).tobytes() for weight in stack.weight}) == 4


def test_widths_come_from_net_arch_unless_set_apart():
    assert PolicyConfig().actor_widths((9, 9)) == (9, 9)
    assert PolicyConfig(net_arch=[8]).actor_widths((9, 9)) == PolicyConfig(net_arch=[8]).critic_widths((9,)) == (8,)
    apart = PolicyConfig(net_arch={"pi": [4], "qf": []})
    assert (apart.actor_widths((9,)), apart.critic_widths((9,))) == ((4,), ())
    half = PolicyConfig(net_arch={"pi": [4]})
    assert (half.actor_widths((9,)), half.critic_widths((9,))) == ((4,), (9,))


class ReLU:
    """Named as ``torch.nn.ReLU`` is."""


class LeakyReLU:
    """Named as ``torch.nn.LeakyReLU`` is."""


@pytest.mark.parametrize(
    ("given", "name"),
    [("Tanh", "tanh"), (jax.nn.elu, "elu"), (ReLU, "relu"), (LeakyReLU, "leakyrelu"), (jnp.tanh, "tanh")],
)
def test_an_activation_is_given_by_name_function_or_class(given, name):
    assert PolicyConfig(activation_fn=given).activation_fn == name


@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        ({"net_arch": 64}, TypeError, "net_arch=64 must be a list of layer widths"),
        ({"net_arch": "64"}, TypeError, "net_arch='64' must be a list"),
        ({"net_arch": [0]}, ValueError, r"net_arch=\[0\] must hold positive whole numbers"),
        ({"net_arch": [6.5]}, ValueError, "must hold positive whole numbers"),
        ({"net_arch": [True]}, ValueError, "must hold positive whole numbers"),
        ({"net_arch": {"vf": [8]}}, ValueError, r"net_arch has the unknown keys \['vf'\]; expected 'pi' and 'qf'"),
        ({"activation_fn": "rellu"}, ValueError, "activation_fn='rellu' is unknown; choose one of relu, tanh"),
    ],
)
def test_a_wrong_shape_of_networks_is_refused(settings, error, words):
    with pytest.raises(error, match=words):
        PolicyConfig(**settings)
