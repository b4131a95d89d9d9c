"""Nested plain data on its way into a file and back."""

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from rejeu.core import records
from rejeu.core.errors import CheckpointError

NUMBERS = st.none() | st.booleans() | st.integers() | st.floats() | st.text()
ARRAYS = hnp.arrays(
    st.sampled_from([np.float32, np.float64, np.int8, np.uint64, np.bool_]), hnp.array_shapes(min_dims=0)
)
SCALARS = st.builds(np.float32, st.floats(width=32)) | st.builds(np.int64, st.integers(-(2**63), 2**63 - 1))
DATA = st.recursive(
    NUMBERS | ARRAYS | SCALARS,
    lambda inner: st.lists(inner) | st.lists(inner).map(tuple) | st.dictionaries(st.text(), inner),
)


def same(one, two):
    if type(one) is not type(two):
        return False
    if isinstance(one, dict):
        return one.keys() == two.keys() and all(same(one[key], two[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(two) and all(map(same, one, two))
    if isinstance(one, np.ndarray | np.generic):
        return one.dtype == two.dtype and one.shape == two.shape and one.tobytes() == two.tobytes()
    return one == two or (isinstance(one, float) and math.isnan(one) and math.isnan(two))


@settings(max_examples=20)
@given(DATA)
def test_everything_comes_back_as_what_it_was(value):
    arrays = {}
    text = json.dumps(records.encode(value, arrays, "x"), allow_nan=False)
    assert same(records.decode(json.loads(text), arrays), value)


def test_arrays_are_copies():
    array, arrays = np.zeros(3), {}
    records.encode([array], arrays, "x")
    array[0] = 1
    assert arrays["x.0"].tolist() == [0, 0, 0]


@pytest.mark.parametrize("value", [object(), {1: 2}, {"a": {3}}, np.array(["text"]), np.array([None]), 1j, b"bytes"])
def test_other_things_are_refused_with_their_place(value):
    with pytest.raises(TypeError, match=r"^x\.1.* expected numbers, strings"):
        records.encode([0, value], {}, "x")


@pytest.mark.parametrize(
    "value",
    [
        {"array": "missing"},
        {"array": 3},
        {"float": "__import__('os')"},
        {"unknown": 1},
        {},
        {"dict": [1]},
        {"tuple": 4},
        {"a": 1, "b": 2},
    ],
)
def test_what_encode_never_returns_is_refused(value):
    with pytest.raises(CheckpointError):
        records.decode(value, {})
