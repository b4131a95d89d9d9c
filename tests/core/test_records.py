"""JSON of files: parsed strictly, converted to typed records, with errors that name the field."""

import msgspec
import numpy as np
import pytest

from rejeu.core.errors import CheckpointError
from rejeu.core.records import Count, EnvCount, Malformed, Seed, convert, parse_json


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("NaN", "not valid JSON"),
        ("[1e999]", "out of range"),
        ("9" * 5000, "out of range"),
        ("[" * 100_000, "nested too deeply"),
        ("[" * 101 + "]" * 101, "nested too deeply"),
        ("[" * 100_000 + "]" * 100_000, "nested too deeply"),
        ("{", "not valid JSON"),
        (b"\xff", "not valid JSON"),
        (b'"\xff"', "not valid JSON"),
    ],
)
def test_json_that_is_not_strict_is_refused(text, words):
    with pytest.raises(Malformed, match=words):
        parse_json(text)


def test_long_integers_and_nesting_within_the_limits_are_read():
    assert parse_json("[" * 100 + "]" * 100)
    assert float(parse_json("9" * 300)) == 1e300


def test_integers_that_no_float_holds_are_refused_by_their_place():
    with pytest.raises(CheckpointError, match=r"\[0\]=10.*: number out of range"):
        convert([10**400], list[float])


class Inner(msgspec.Struct):
    n_envs: EnvCount
    seeds: list[Seed]


class Record(msgspec.Struct):
    inner: Inner
    array: np.ndarray
    counts: dict[str, Count] = {}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inner": {"n_envs": 5000, "seeds": []}}, "inner.n_envs=5000: expected `int` <= 4096"),
        ({"inner": {"n_envs": True, "seeds": []}}, "inner.n_envs=True: expected `int`, got `bool`"),
        ({"inner": {"n_envs": 1, "seeds": [0, -1]}}, "inner.seeds[1]=-1: expected `int` >= 0"),
        ({"inner": {"n_envs": 1}}, "inner={'n_envs': 1}: object missing required field `seeds`"),
        ({"array": [1]}, "array=[1]: expected `numpy.ndarray`, got `list`"),
        ({"counts": {"a": "x"}}, "counts[...]: expected `int`, got `str`"),
        ({"counts": {1: 2}}, "key in $.counts: expected `str`, got `int`"),
    ],
)
def test_an_error_says_what_was_received_and_expected(change, message):
    good = {"inner": {"n_envs": 1, "seeds": [0]}, "array": np.zeros(2), "later": 3}
    assert convert(good, Record).inner.seeds == [0]
    with pytest.raises(CheckpointError) as caught:
        convert({**good, **change}, Record)
    assert str(caught.value) == message
    with pytest.raises(CheckpointError, match=r"^object missing required field `inner`$"):
        convert({}, Record)
