"""Arrays by name in the safetensors format: 8 bytes of length, a JSON table of dtypes, shapes and offsets, the arrays.

The safetensors library reads it, without mapping the file into memory: a mapped file that shrinks ends the process. It
cannot write an array at a time to an open file, which saves copying a replay buffer and reports a full disk as
``OSError``; so files are written here.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from safetensors import safe_open

from rejeu.io.records import Malformed, shown

DTYPES = {"F32": "float32", "F64": "float64", "I64": "int64", "I32": "int32", "I16": "int16", "I8": "int8"}
DTYPES |= {"U64": "uint64", "U32": "uint32", "U16": "uint16", "U8": "uint8", "BOOL": "bool", "F16": "float16"}
"""The dtypes that are read and written, by their names in the format."""
MAX_TABLE = 4 * 2**20
"""Upper limit on the bytes of a table."""
METADATA = "__metadata__"


class Spec(NamedTuple):
    """Shape and dtype of an array in a file."""

    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def size(self) -> int:
        """The number of elements."""
        return math.prod(self.shape)

    @property
    def nbytes(self) -> int:
        """The size in bytes."""
        return self.size * self.dtype.itemsize


class TensorFile:
    """An open file: metadata and specs are read at once, arrays when they are asked for. A context manager."""

    def __init__(self, path: Path) -> None:
        """Opens the file.

        Raises:
            Malformed: if the table is too large, or holds dtypes that rejeu does not write.
            SafetensorError: if it is not a valid safetensors file.
            OSError: if it cannot be read.
        """
        with path.open("rb") as file:
            size = int.from_bytes(file.read(8), "little")
        if size > MAX_TABLE:  # else the objects built from it could take gigabytes
            raise Malformed(f"its table has {size} bytes, expected at most {MAX_TABLE}")
        self._file = safe_open(path, framework="numpy", backend="pread")
        self.metadata: dict[str, str] = self._file.metadata() or {}
        self.specs: dict[str, Spec] = {}
        """By name, in the order of the offsets."""
        for name in self._file.offset_keys():
            array = self._file.get_slice(name)
            if (dtype := array.get_dtype()) not in DTYPES:
                raise Malformed(f"{shown(name)} has the dtype {shown(dtype)}, which rejeu does not write")
            self.specs[name] = Spec(tuple(array.get_shape()), np.dtype(DTYPES[dtype]))

    def read(self, name: str) -> np.ndarray:
        """Returns an array.

        Raises:
            SafetensorError: if the file ends before the array does.
        """
        return self._file.get_tensor(name)

    def __enter__(self) -> TensorFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.__exit__(None, None, None)


def contiguous(name: str, value: Any) -> np.ndarray:
    """Returns an array as it is written: contiguous and little-endian.

    Raises:
        TypeError: for other dtypes than those in ``DTYPES``.
    """
    array = np.asarray(value)
    if array.dtype.name not in DTYPES.values():
        raise TypeError(f"{shown(name)} has the dtype {array.dtype}; expected one of {', '.join(DTYPES.values())}")
    return np.asarray(array, dtype=array.dtype.newbyteorder("<"), order="C")


def as_bytes(array: np.ndarray) -> memoryview:
    """Returns the bytes of a contiguous array without copying them."""
    return array.reshape(-1).view(np.uint8).data


def table(arrays: Mapping[str, Any], metadata: Mapping[str, str]) -> tuple[bytes, list[str]]:
    """Returns everything that precedes the arrays in a file, and their names in the order in which they follow.

    The widest dtypes come first, so that all arrays are aligned.

    Raises:
        ValueError: if the table is too large, or a name is not valid.
    """
    if METADATA in arrays:
        raise ValueError(f"no array may be called {METADATA}")
    codes = {dtype: code for code, dtype in DTYPES.items()}
    dtypes = {name: np.asarray(value).dtype for name, value in arrays.items()}
    names = sorted(arrays, key=lambda name: (-dtypes[name].itemsize, name))
    entries: dict[str, Any] = {METADATA: dict(metadata)}
    begin = 0
    for name in names:
        shape = np.shape(arrays[name])
        end = begin + math.prod(shape) * dtypes[name].itemsize
        entries[name] = {"dtype": codes[dtypes[name].name], "shape": shape, "data_offsets": [begin, end]}
        begin = end
    content = json.dumps(entries, separators=(",", ":"), ensure_ascii=False).encode()
    content += b" " * (-len(content) % 8)
    if len(content) > MAX_TABLE:
        raise ValueError(
            f"the header has {len(content)} bytes, expected at most {MAX_TABLE}; use arrays for many numbers"
        )
    return len(content).to_bytes(8, "little") + content, names
