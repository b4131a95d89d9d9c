"""The safetensors format: 8 bytes of length, a JSON table of names, dtypes, shapes and places, then the arrays.

Everything that a table says is checked against the size of the file before anything is allocated, and arrays are read
and written one at a time. The safetensors library reads what is written here, and the reverse; it is not used, because it
maps files into memory (where one that shrinks meanwhile ends the process), reports a full disk without saying so in a way
that a program can tell, and takes a table at its word until an array is asked for.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from typing import Any, BinaryIO, NamedTuple

import numpy as np

DTYPES = {"F32": "float32", "F64": "float64", "I64": "int64", "I32": "int32", "I16": "int16", "I8": "int8"}
DTYPES |= {"U64": "uint64", "U32": "uint32", "U16": "uint16", "U8": "uint8", "BOOL": "bool", "F16": "float16"}
"""The dtypes that are read and written, by their names in the format."""
MAX_TABLE = 4 * 2**20
"""Most bytes of a table."""
MAX_DEPTH = 100
"""Most brackets within each other in any JSON."""
MAX_TOKENS = 2**18
"""Most brackets and quotes in any JSON, those of some ten thousand arrays: what is built from them takes time and room."""
LARGEST_INTEGER = 2**128
"""What whole numbers in any JSON stay below; the states of NumPy's generators have 128 bits."""
MAX_AXES = 32
METADATA = "__metadata__"


class Malformed(ValueError):
    """Bytes are not what the format asks for; the message says where."""


class Entry(NamedTuple):
    """One array of a file, before it is read."""

    name: str
    dtype: str
    """As in the format, such as ``"F32"``; of other programs' files perhaps none of ``DTYPES``."""
    shape: tuple[int, ...]
    begin: int
    """Where its bytes begin, counted from the end of the table."""
    end: int


class Spec(NamedTuple):
    """Shape and dtype of an array that was not read yet."""

    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def size(self) -> int:
        """Its number of elements."""
        return math.prod(self.shape)

    @property
    def nbytes(self) -> int:
        """Its size in bytes."""
        return self.size * self.dtype.itemsize


class Table(NamedTuple):
    """What stands before the arrays of a file."""

    metadata: dict[str, str]
    entries: list[Entry]
    """In the order of their places."""
    start: int
    """Where the arrays begin in the file."""


def parse_json(text: str) -> Any:
    """Returns the value of a JSON text, of bounded depth, without names given twice or numbers that are none.

    Raises:
        Malformed: if it is no such text.
    """
    _check_depth(text)
    try:
        return json.loads(
            text,
            parse_constant=_refuse_constant,
            parse_float=_finite,
            parse_int=_whole,
            object_pairs_hook=_without_duplicates,
        )
    except Malformed:
        raise
    except (ValueError, RecursionError) as error:
        raise Malformed(f"no JSON: {str(error)[:80]}") from None


def read_table(file: BinaryIO, size: int) -> Table:
    """Reads and checks the table of a file of ``size`` bytes; the arrays lie side by side in what follows it.

    Raises:
        Malformed: unless every entry says what it should, and all of them fill the file exactly.
    """
    prefix = file.read(8)
    length = int.from_bytes(prefix, "little")
    if len(prefix) < 8 or length > size - 8:
        raise Malformed("it ends before its table does")
    if length > MAX_TABLE:
        raise Malformed(f"its table of {length} bytes is longer than {MAX_TABLE}")
    content = file.read(length)
    if len(content) < length:
        raise Malformed("it ends before its table does")
    try:
        table = parse_json(content.decode("utf-8"))
    except UnicodeDecodeError:
        raise Malformed("its table is no text") from None
    if not isinstance(table, dict):
        raise Malformed("its table is no JSON object")
    metadata = table.pop(METADATA, {})
    if not isinstance(metadata, dict) or not all(isinstance(value, str) for value in metadata.values()):
        raise Malformed("its metadata are not texts by name")
    entries = sorted((_entry(name, value) for name, value in table.items()), key=lambda e: (e.begin, e.end))
    place = 0
    for entry in entries:
        if entry.begin != place:
            raise Malformed(f"{shown(entry.name)} begins at {entry.begin} where {place} is expected")
        place = entry.end
    if place != size - 8 - length:
        raise Malformed(f"its arrays have {place} bytes and {size - 8 - length} follow the table")
    return Table(metadata, entries, 8 + length)


def read_array(file: BinaryIO, entry: Entry) -> np.ndarray:
    """Reads the array that begins where ``file`` stands; its dtype is one of ``DTYPES``.

    Raises:
        Malformed: if the file ends before it, or truth values are neither 0 nor 1.
        MemoryError: if there is no room for it.
    """
    dtype = np.dtype(DTYPES[entry.dtype]).newbyteorder("<")
    array = np.empty(entry.shape, dtype)
    if file.readinto(as_bytes(array)) != array.nbytes:  # type: ignore[attr-defined]
        raise Malformed(f"it ends within {shown(entry.name)}")
    if entry.dtype == "BOOL" and array.view(np.uint8).max(initial=0) > 1:
        raise Malformed(f"{shown(entry.name)} holds truth values other than 0 and 1")
    return array.astype(dtype.newbyteorder("="), copy=False)


def plain(name: str, value: Any) -> np.ndarray:
    """Returns an array as its bytes are written: contiguous, little-endian.

    Raises:
        TypeError: for a dtype that the format has not, or that is not read again.
    """
    array = np.asarray(value)
    if array.dtype.name not in DTYPES.values():
        raise TypeError(f"{shown(name)} has the dtype {array.dtype}; expected one of {', '.join(DTYPES.values())}")
    return np.asarray(array, dtype=array.dtype.newbyteorder("<"), order="C")


def as_bytes(array: np.ndarray) -> memoryview:
    """Returns the bytes of a contiguous array, not copied."""
    return array.reshape(-1).view(np.uint8).data


def layout(arrays: Mapping[str, Any]) -> list[Entry]:
    """Returns where each array is to lie: the widest numbers first, so that all are aligned, then by name."""
    kinds = {dtype: name for name, dtype in DTYPES.items()}
    sized = [(np.asarray(value).dtype, name, np.shape(value)) for name, value in arrays.items()]
    entries, place = [], 0
    for dtype, name, shape in sorted(sized, key=lambda part: (-part[0].itemsize, part[1])):
        end = place + math.prod(shape) * dtype.itemsize
        entries.append(Entry(name, kinds[dtype.name], shape, place, end))
        place = end
    return entries


def table_bytes(entries: list[Entry], metadata: Mapping[str, str]) -> bytes:
    """Returns what stands before the arrays of a file.

    Raises:
        ValueError: if it would be too long to be read again, or a name is no text.
    """
    table: dict[str, Any] = {METADATA: dict(metadata)}
    for entry in entries:
        if entry.name == METADATA:
            raise ValueError(f"no array may be called {METADATA}")
        table[entry.name] = {
            "dtype": entry.dtype,
            "shape": list(entry.shape),
            "data_offsets": [entry.begin, entry.end],
        }
    text = json.dumps(table, separators=(",", ":"), ensure_ascii=False)
    parse_json(text)
    content = text.encode("utf-8")
    content += b" " * (-len(content) % 8)
    if len(content) > MAX_TABLE:
        raise ValueError(f"the header has {len(content)} bytes and may have {MAX_TABLE}; keep many numbers in arrays")
    return len(content).to_bytes(8, "little") + content


def shown(name: Any) -> str:
    """Returns a name from a file as an error may show it: on one line, and not endless."""
    text = str(name)
    text = text if text.isprintable() else ascii(text)[1:-1]
    return text if len(text) <= 100 else text[:97] + "..."


def _entry(name: str, value: Any) -> Entry:
    if not isinstance(value, dict) or set(value) != {"dtype", "shape", "data_offsets"}:
        raise Malformed(f"the entry of {shown(name)} is not dtype, shape and data_offsets")
    dtype, shape, offsets = value["dtype"], value["shape"], value["data_offsets"]
    if not isinstance(dtype, str) or not _whole_numbers(shape) or not _whole_numbers(offsets) or len(offsets) != 2:
        raise Malformed(f"the entry of {shown(name)} is not a dtype, whole numbers and two places")
    if len(shape) > MAX_AXES or math.prod(max(n, 1) for n in shape) >= 2**60:
        raise Malformed(f"the shape of {shown(name)} is beyond reason")
    begin, end = offsets
    if begin > end:
        raise Malformed(f"{shown(name)} ends before it begins")
    if dtype in DTYPES and math.prod(shape) * np.dtype(DTYPES[dtype]).itemsize != end - begin:
        raise Malformed(f"{shown(name)} has {end - begin} bytes, which is not {DTYPES[dtype]}{shape}")
    return Entry(name, dtype, tuple(shape), begin, end)


def _whole_numbers(value: Any) -> bool:
    return isinstance(value, list) and all(type(n) is int and n >= 0 for n in value)


def _check_depth(text: str) -> None:
    """Raises ``Malformed`` where brackets go too deep or there are too many; in time proportional to the text."""
    depth, in_string = 0, False
    for count, match in enumerate(re.finditer(r'\\.?|["\[\]{}]', text, re.DOTALL)):
        token = match[0]
        if count > MAX_TOKENS:
            raise Malformed(f"JSON of more than {MAX_TOKENS} brackets and quotes")
        if token == '"':
            in_string = not in_string
        elif not in_string and token in "[{":
            depth += 1
            if depth > MAX_DEPTH:
                raise Malformed(f"JSON more than {MAX_DEPTH} brackets deep")
        elif not in_string and token in "]}":
            depth -= 1


def _refuse_constant(name: str) -> None:
    raise Malformed(f"{name} is no JSON number")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise Malformed(f"{text[:20]} is no finite number")
    return value


def _whole(text: str) -> int:
    if len(text) > 40 or not -LARGEST_INTEGER < (value := int(text)) < LARGEST_INTEGER:
        raise Malformed("a whole number of more than 128 bits")
    return value


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        seen: set[str] = set()
        for name, _ in pairs:
            if name in seen:
                raise Malformed(f"the name {shown(name)} is given twice")
            seen.add(name)
    return found
