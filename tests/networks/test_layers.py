"""The layers that all networks are made of, against NumPy, and the shapes that users may ask for."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from rejeu.core.algorithm import ensemble
from rejeu.networks import ACTIVATIONS, Linear, PolicyConfig
from rejeu.networks.layers import product

pytestmark = pytest.mark.usefixtures("strict_dtypes")
KEY = jax.random.PRNGKey(0)


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
