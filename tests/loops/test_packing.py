"""Packing many arrays into few is exact, and large arrays are left alone."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st

from rejeu.loops import packing
from rejeu.loops.packing import HostPacker, Message, Packing, Readings

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


@given(trees(), st.sampled_from([3, 10, packing.LARGE]))
def test_unpacking_gives_the_tree_back(tree, large):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(packing, "LARGE", large)
        plan = Packing(tree)
    on_host = plan.pack_leaves(jax.tree.leaves(tree))
    on_device = plan.pack(jax.tree.map(jnp.asarray, tree))
    assert_same(plan.unpack(on_host), tree)
    assert_same(plan.unpack(on_device), tree)
    n_large = sum(leaf.size > large for leaf in jax.tree.leaves(tree))
    small = {leaf.dtype for leaf in jax.tree.leaves(tree) if leaf.size <= large}
    assert len(on_host) == len(on_device) == n_large + len(small)


@given(trees(), st.sampled_from([3, 10, packing.LARGE]))
def test_a_message_arrives_as_it_was_sent(tree, large):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(packing, "LARGE", large)
        plan = Message(tree)
    sent = plan.pack(jax.tree.leaves(tree))
    assert_same(jax.jit(plan.unpack)(sent), tree)
    assert len(sent) == 1 + sum(leaf.size > large for leaf in jax.tree.leaves(tree))


def test_every_bit_of_a_message_arrives():
    words = np.array([0x7FC12345, 0x7F812345, 0x80000000, 0x00000001, 0xFFFFFFFF], np.uint32)  # NaN, -0, denormal
    tree = {"f": words.view(np.float32), "u": words, "i": words.view(np.int32)}
    plan = Message(tree)
    arrived = jax.jit(plan.unpack)(plan.pack(jax.tree.leaves(tree)))
    assert {key: np.asarray(a).view(np.uint32).tolist() for key, a in arrived.items()} == {
        k: words.tolist() for k in tree
    }


def test_numbers_of_64_bits_arrive_as_jax_has_them_and_views_as_their_elements():
    table = np.zeros(4, [("a", np.float32, 2), ("b", np.int64)])
    table["a"], table["b"] = np.arange(8).reshape(4, 2), -np.arange(4)
    tree = (table["a"], table["b"], np.float64(0.1), np.float16([0.5, np.inf]))
    plan = Message(tree)
    a, b, c, d = jax.jit(plan.unpack)(plan.pack(jax.tree.leaves(tree)))
    np.testing.assert_array_equal(a, np.arange(8, dtype=np.float32).reshape(4, 2))
    assert (b.dtype, b.tolist()) == (np.int32, [0, -1, -2, -3])
    assert (c.dtype, float(c)) == (np.float32, float(np.float32(0.1)))
    assert (d.dtype, d.tolist()) == (np.float16, [0.5, np.inf])


def records(n, seed=0):
    """Random rows of a table of words, and some of its columns in another order than they stand in."""
    table = np.zeros(n, [("a", np.float32, 2), ("b", np.int32), ("c", np.float32), ("d", np.uint32, (1, 3))])
    rng = np.random.default_rng(seed)
    table["a"], table["c"] = rng.normal(size=(n, 2)), rng.normal(size=n)
    table["b"], table["d"] = rng.integers(-9, 9, n), rng.integers(2**32, size=(n, 1, 3))
    return table, {"d": table["d"], "a": table["a"], "b": table["b"]}


@pytest.mark.parametrize("lead", [(6,), (2, 3), (1, 6)])
@pytest.mark.parametrize("large", [10, packing.LARGE])
def test_fields_of_records_are_sent_as_the_records(monkeypatch, lead, large):
    monkeypatch.setattr(packing, "LARGE", large)
    table, fields = records(6)
    tree = {
        "fields": {k: v.reshape(*lead, *v.shape[1:]) for k, v in fields.items()},
        "other": np.arange(3, dtype=np.int32),
    }
    plan = Message(tree)
    (part,) = plan.together
    assert (part.shape, part.offsets) == ((6, 7), (0, 2, 4))  # by the order of the leaves: a, b, d
    packed = plan.pack(jax.tree.leaves(tree))
    assert [a.size for a in packed] == ([3, 42] if large == 10 else [45])
    assert_same(jax.jit(plan.unpack)(packed), tree)
    assert np.shares_memory(packed[-1], table) is (large == 10)


def test_copies_of_fields_of_records_arrive_too():
    packer = HostPacker()
    unpacked = []
    plans = []
    for seed, copy in [(0, False), (1, True), (2, False), (3, True)]:
        tree = jax.tree.map(np.copy, records(4, seed)[1]) if copy else records(4, seed)[1]
        arrays, plan = packer(tree, "four")
        plans.append(plan)
        unpacked.append((jax.jit(plan.unpack)(arrays), tree))
    for arrived, tree in unpacked:
        assert_same(arrived, tree)
    assert plans[0] is plans[2]
    assert plans[1] is plans[3]


def test_what_is_no_field_of_words_is_sent_by_itself():
    table = np.zeros(6, [("a", np.float32, 2), ("c", np.float32)])
    table["a"], table["c"] = np.arange(12).reshape(6, 2), -np.arange(6)
    narrow = np.zeros(6, [("b", np.uint8, 8), ("c", np.int64)])
    uneven = np.zeros(6, [("u", np.uint8), ("a", np.float32, 2), ("c", np.uint8, 2)])
    a = table["a"]
    views = [table[::-1]["a"], a[::-1], a[:, ::-1], a[:3], a.T, a[:, :1], table["c"], a.reshape(2, 3, 2)[::-1]]
    others = [narrow["b"], narrow["c"], uneven["a"], a.copy(), np.float32(1), np.zeros((0, 2), np.float32)]
    assert Message([a]).together
    for alone in views + others:
        plan = Message([alone])
        assert plan.together == []
        assert_same(jax.jit(plan.unpack)(plan.pack([alone])), [jnp.asarray(alone)])


def test_vectors_are_copies_and_large_arrays_are_not():
    small, large = np.ones(3, np.float32), np.ones(packing.LARGE + 1, np.float32)
    (vector, whole), _ = HostPacker()([small, large], "one")
    assert not np.shares_memory(vector, small)
    assert whole is large


def test_one_plan_serves_all_trees_of_a_size():
    packer = HostPacker()
    _, first = packer({"a": np.zeros(2, np.float32)}, 2)
    (vector,), same = packer({"a": np.ones(2, np.float32)}, 2)
    _, other = packer({"a": np.ones(3, np.float32)}, 3)
    assert first is same
    assert other is not first
    assert vector.tolist() == [1.0, 1.0]


def test_readings_are_a_mapping_of_one_vector():
    readings = jax.jit(lambda: Readings.of({"b": jnp.float32(2), "a": jnp.float32(1)}))()
    assert list(readings) == ["b", "a"]
    assert {name: float(value) for name, value in readings.items()} == {"b": 2.0, "a": 1.0}
    assert "c" not in readings
    with pytest.raises(KeyError, match="c"):
        readings["c"]
