"""Functions that are compiled for one call, and functions with marks for XLA's CPU compiler."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rejeu.algorithms import optimizers
from rejeu.core import algorithm as core, xla
from rejeu.training.learner import Packing


def test_what_runs_once_is_computed_also_where_xla_does_not_know_the_options(monkeypatch):
    monkeypatch.setattr(xla, "RUN_ONCE", {"xla_an_option_that_is_gone": False})
    with pytest.raises(jax.errors.JaxRuntimeError, match="No such compile option"):
        jax.jit(lambda x: 2.0 * x, compiler_options=xla.RUN_ONCE)(jnp.float32(3.0))
    assert xla.run_once(lambda x: 2.0 * x)(jnp.float32(3.0)) == 6.0


def test_other_errors_of_the_device_are_not_hidden():
    def broken(x):
        def raises(_):
            raise RuntimeError("the cause")

        return jax.pure_callback(raises, x, x)

    with pytest.raises(jax.errors.JaxRuntimeError, match="the cause"):
        jax.block_until_ready(xla.run_once(broken)(jnp.float32(1.0)))


@pytest.mark.parametrize("wrapped", [xla.outlined, xla.one_kernel])
def test_a_function_apart_computes_the_same_and_takes_any_tree_and_setting(wrapped):
    def function(tree, factor, activation, *, nothing):
        assert nothing is None
        return {"sum": tree["a"] + factor * tree["b"], "activated": activation(tree["a"]), "a": tree["a"]}

    tree = {"a": jnp.linspace(-1.0, 1.0, 7), "b": np.arange(7, dtype=np.float32)}
    expected = function(tree, 0.5, jnp.tanh, nothing=None)
    inside = jax.jit(lambda tree: wrapped(function)(tree, 0.5, jnp.tanh, nothing=None))
    for found in (wrapped(function)(tree, 0.5, jnp.tanh, nothing=None), inside(tree)):
        jax.tree.map(lambda e, f: np.testing.assert_allclose(f, e, rtol=1e-6), expected, found)


@pytest.mark.parametrize("wrapped", [xla.outlined, xla.one_kernel])
def test_a_function_apart_may_be_differentiated_and_batched(wrapped):
    cube = wrapped(lambda x: x**3)
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.grad(cube)))(jnp.arange(4.0)), 3 * np.arange(4.0) ** 2, rtol=1e-6)


@pytest.mark.parametrize("n_runs", [1, 8])
def test_a_packed_state_that_xla_splits_between_threads_is_compiled(n_runs):
    leaves = [jnp.full((n_runs, 8192 // n_runs), i, jnp.float32) for i in range(12)]
    packing = Packing([leaf[0] for leaf in leaves])

    def doubled(leaves):
        return xla.one_kernel(packing.pack, packing.longest)([2 * leaf for leaf in leaves])

    packed = jax.vmap(xla.for_runs(doubled, n_runs))
    (found,) = jax.jit(packed)(leaves)
    assert found.reshape(n_runs, 12, -1)[:, :, 0].tolist() == [[2.0 * i for i in range(12)]] * n_runs


def test_a_step_with_compiled_functions_inside_is_compiled_for_several_runs():
    """RAdam, of PQN, selects by ``jnp.where``, which is such a function."""
    optimizer = optimizers.make("radam")
    weights = [jnp.ones((3, 128, 128))]
    begin = weights, jax.vmap(optimizer.init)(weights)

    def steps(begin):
        step = lambda _, now: core.descend(now[0], now[0], now[1], optimizer, 0.1)  # noqa: E731
        return jax.lax.fori_loop(0, 2, step, begin)[0]

    (found,) = jax.jit(jax.vmap(xla.for_runs(steps, 3)))(begin)
    (expected,) = steps(jax.tree.map(lambda x: x[0], begin))
    np.testing.assert_allclose(found, jnp.broadcast_to(expected, found.shape), rtol=1e-6)


def test_other_processors_are_told_nothing(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    traced = jax.make_jaxpr(xla.one_kernel(lambda x: 2.0 * x))(jnp.ones(3))
    assert [equation.primitive.name for equation in traced.eqns] == ["mul"]
