"""What is compiled for a single call is compiled quickly, by whichever XLA there is."""

import jax
import jax.numpy as jnp
import pytest

from rejeu import compilation


def test_what_runs_once_is_computed_also_where_xla_does_not_know_the_options(monkeypatch):
    monkeypatch.setattr(compilation, "RUN_ONCE", {"xla_an_option_that_is_gone": False})
    with pytest.raises(jax.errors.JaxRuntimeError, match="No such compile option"):
        jax.jit(lambda x: 2.0 * x, compiler_options=compilation.RUN_ONCE)(jnp.float32(3.0))
    assert compilation.run_once(lambda x: 2.0 * x)(jnp.float32(3.0)) == 6.0


def test_other_errors_of_the_device_are_not_hidden():
    def broken(x):
        def raises(_):
            raise RuntimeError("the cause")

        return jax.pure_callback(raises, x, x)

    with pytest.raises(jax.errors.JaxRuntimeError, match="the cause"):
        jax.block_until_ready(compilation.run_once(broken)(jnp.float32(1.0)))
