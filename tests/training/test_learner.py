"""Packing many arrays into few is exact, and large arrays are left alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from rejeu.training import learner
from rejeu.training.learner import Packing, Readings

DTYPES = ("float32", "int32", "uint32", "uint8", "bool")
SHAPES = ((), (1,), (3,), (2, 3), (0, 2), (4, 1, 2), (5, 7))


@st.composite
def trees(draw):
    """A nested tree of arrays of all kinds, the numbers all different."""
    rng = np.random.default_rng(draw(st.integers(0, 9)))
    kinds = draw(st.lists(st.tuples(st.sampled_from(DTYPES), st.sampled_from(SHAPES)), min_size=1, max_size=9))
    arrays = [rng.integers(0, 200, shape).astype(dtype) for dtype, shape in kinds]
    return {"first": arrays[0], "others": tuple(arrays[1:]), "nothing": None}


def assert_same(one, two):
    assert jax.tree.structure(one) == jax.tree.structure(two)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        np.testing.assert_array_equal(a, b)


@settings(max_examples=12)
@given(trees(), st.sampled_from([3, 10, learner.LARGE]))
def test_unpacking_gives_the_tree_back(tree, large):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learner, "LARGE", large)
        plan = Packing(tree)
    on_host = plan.pack(tree, np.concatenate)
    on_device = plan.pack(jax.tree.map(jnp.asarray, tree))
    assert_same(plan.unpack(on_host), tree)
    assert_same(plan.unpack(on_device), tree)
    n_large = sum(leaf.size > large for leaf in jax.tree.leaves(tree))
    small = {leaf.dtype for leaf in jax.tree.leaves(tree) if leaf.size <= large}
    assert len(on_host) == len(on_device) == n_large + len(small)


def test_readings_are_a_mapping_of_one_vector():
    readings = jax.jit(lambda: Readings.of({"b": jnp.float32(2), "a": jnp.float32(1)}))()
    assert list(readings) == ["b", "a"]
    assert {name: float(value) for name, value in readings.items()} == {"b": 2.0, "a": 1.0}
    assert "c" not in readings
    with pytest.raises(KeyError, match="c"):
        readings["c"]
