"""Pickles that would take endless time or memory: each is refused at once, whatever its parts are."""

import re
import time

import numpy as np
import pytest

from rejeu.checkpoints import pickled
from rejeu.core.records import Malformed

SHARED = b"()q\x00" + b"".join(b"h%ch%c\x86q%c" % (i, i, i + 1) for i in range(60)) + b"t"
"""A tuple of two equal tuples of two equal tuples, and so on: 2^60 parts, of which a hash reads all."""
TORCH = b"ctorch._utils\n_rebuild_tensor_v2\nr\x00\x01\x00\x00"
STORAGE = (
    b"(X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000X\x03\x00\x00\x00cpuK\x04tQr\x01\x01\x00\x00"
)


def text(n: int, start: bytes = b"", letter: bytes = b"a") -> bytes:
    """Returns a text of ``n`` letters."""
    return b"X" + n.to_bytes(4, "little") + start + letter * (n - len(start))


HOSTILE = {
    "module of shared parts": (b"X\x01\x00\x00\x00a" + SHARED + b"X\x01\x00\x00\x00a\x93.", "names tuple.a"),
    "name of shared parts": (b"X\x05\x00\x00\x00torch" + SHARED + b"\x93.", "names torch.tuple"),
    "key of shared parts": (b"}" + SHARED + b"K\x01s.", "a key that is no text"),
    "storage of shared parts": (SHARED + b"Q.", "a tensor whose storage is not described by"),
    "storage of a long text": (text(3_000_000) + b"q\x01" + b"h\x01Q" * 60_000 + b".", "a tensor whose storage is not"),
    "shape of shared parts": (
        b"(" + TORCH + STORAGE + SHARED + TORCH + b"(j\x01\x01\x00\x00K\x00h\x3ch\x3ctR.", "shape is not valid"),
    "long shapes": (
        b"(" + b"K\x01" * 90_000 + b"tq\x01" + TORCH + STORAGE + b"(j\x01\x01\x00\x00K\x00h\x01h\x01tq\x03"
        + b"j\x00\x01\x00\x00h\x03R" * 20_000 + b".", "shape or strides are no tuple of at most 8 numbers"),
    "long modules": (
        text(3_000_000, b"torch", b".") + b"q\x00X\x01\x00\x00\x00aq\x01" + b"h\x00h\x01\x93" * 60_000 + b".", "names torch"),
    "sets of a long text": (
        b"cbuiltins\nset\nq\x00" + text(3_000_000) + b"\x85q\x01" + b"h\x00h\x01R" * 60_000 + b".", "a set of a str"),
    "copies of a set": (
        b"(cbuiltins\nset\nq\x00](" + b"K\x01" * 60_000 + b"e\x85q\x01" + b"h\x00h\x01R" * 40_000 + b"t.", "shared so often"),
    "deep tuples": (b")" + b"\x85" * 150_000 + b".", "nested in more than 100 levels"),
    "deep lists": (b"]" * 60_000 + b"a" * 59_999 + b".", "nested in more than 100 levels"),
    "endless list": (b"]q\x00h\x00a.", "nested in more than 100 levels|shared so often"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_parts_are_judged_before_they_are_hashed_compared_or_copied(name):
    content, message = HOSTILE[name]
    began = time.process_time()
    with pytest.raises(ValueError, match=message) as caught:
        pickled.structure(b"\x80\x04" + content, lambda key: bytes(16), 1000)
    assert time.process_time() - began < 3
    assert len(str(caught.value)) < 300
    assert isinstance(caught.value, Malformed)


def test_a_dtype_of_a_million_fields_is_refused_before_it_is_made():
    dtype = pickled.PickledCall(pickled.Name("numpy", "dtype"), ("f8," * 1_000_000,))
    with pytest.raises(Malformed, match="no dtype"):
        pickled.dtype_of(dtype)
    assert pickled.dtype_of(pickled.PickledCall(pickled.Name("numpy", "dtype"), ("f8",))) == np.float64


def test_a_set_is_a_list_and_arrays_may_have_several_names():
    assert pickled.parse(b"\x80\x04cbuiltins\nset\n](K\x01K\x02e\x85R.") == [1, 2]
    array = np.zeros(100)
    pickled.check_size({"a": array, "b": [array, array]}, 1000, 3 * array.nbytes)
    with pytest.raises(Malformed, match=re.escape("larger than the file")):
        pickled.check_size([array] * 4, 1000, 3 * array.nbytes)
