"""rejeu's keys give the numbers that JAX's give, bit for bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rejeu.core.prng import nth, threefry

DRAWS = {
    "normal": lambda key: jax.random.normal(key, (3, 5)),
    "a single normal": jax.random.normal,
    "uniform": lambda key: jax.random.uniform(key, (7,), minval=-2.0, maxval=3.0),
    "whole numbers": lambda key: jax.random.randint(key, (9,), 0, 100),
    "categories": lambda key: jax.random.categorical(key, jnp.log(jnp.array([[0.2, 0.5, 0.3]] * 8))),
    "bytes": lambda key: jax.random.bits(key, (11,), jnp.uint8),
    "nothing": lambda key: jax.random.normal(key, (0, 2)),
    "after splitting": lambda key: jax.random.normal(jax.random.split(key, 5)[3], (4,)),
    "many at once": lambda key: jax.vmap(lambda k: jax.random.normal(k, (2,)))(jax.random.split(key, 3)),
    "after folding in": lambda key: jax.random.normal(jax.random.fold_in(key, 2**32 - 1), (4,)),
}


@pytest.mark.parametrize("draw", DRAWS.values(), ids=DRAWS)
@pytest.mark.parametrize(("seed", "n"), [(0, 0), (1, 7), (2**32 - 1, 2**32 - 1)])
def test_numbers_are_those_of_jax(draw, seed, n):
    key = jax.random.PRNGKey(seed)
    expected = draw(jax.random.fold_in(jax.random.wrap_key_data(key, impl="threefry2x32"), np.uint32(n)))
    found = jax.jit(lambda key, n: draw(nth(key, n)))(key, np.uint32(n))
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)


def test_the_hash_gives_its_authors_known_answers():
    """From the file of known answers of Random123: threefry2x32, 20 rounds, key and counter 0."""
    high, low = threefry(jnp.zeros(2, jnp.uint32), jnp.zeros((), jnp.uint32))
    assert (hex(int(high)), hex(int(low))) == ("0x6b200159", "0x99ba4efe")


def test_wide_numbers_are_those_of_jax():
    """As in environments in JAX and algorithms that draw in the default dtype with ``jax_enable_x64``."""
    with jax.enable_x64(True):
        expected = jax.random.uniform(jax.random.fold_in(jax.random.key(3, impl="threefry2x32"), np.uint32(5)), (7,))
        found = jax.random.uniform(nth(jax.random.PRNGKey(3), 5), (7,))
        assert found.dtype == np.float64
        np.testing.assert_array_equal(found, expected)


ROUNDS = 20
of_xla_on_cpus = pytest.mark.skipif(jax.default_backend() != "cpu", reason="of XLA on CPUs")


def n_rounds(function, *arguments):
    """Returns how many rounds of the hash are in the compiled program."""
    return jax.jit(function).lower(*arguments).compile().as_text().count(" shift-left(")


@of_xla_on_cpus
def test_keys_are_computed_apart_from_what_is_drawn_with_them():
    """In JAX 0.12 LLVM does not finish a loop with the rounds of both (``XLA_FLAGS=`` shows it, as no test is optimized)."""

    def draw(key, step):
        some_key, other_key = jax.random.split(nth(key, step))
        return jax.random.uniform(some_key, (4,)) * jax.random.uniform(other_key, (4,))

    hashes = ("nth", "split", "uniform", "uniform")
    assert n_rounds(draw, jax.random.PRNGKey(0), np.uint32(3)) == ROUNDS * len(hashes)


@of_xla_on_cpus
def test_numbers_that_several_kernels_read_are_hashed_once():
    """XLA repeats what is elementwise in each of them; repeated hashes once doubled the time to compile an update."""

    def rotations(n_readers):
        def readers(key, scales):
            noise = jax.random.normal(nth(key, 0), (64, 2))
            return [jnp.sum(jnp.exp(scales[i] * noise), axis=i % 2) for i in range(n_readers)]

        return n_rounds(readers, jax.random.PRNGKey(0), jnp.arange(1.0, 6.0))

    assert 0 < rotations(5) <= rotations(1)
