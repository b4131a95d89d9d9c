"""Files: named arrays and a JSON header in one safetensors file, written atomically, read without executing code.

Reading builds every object from rejeu's own classes and from what the caller expects; the file supplies only numbers and
JSON values, and names, shapes and dtypes must match. ``docs/file-format.md`` describes the files and their guarantees.

Checksums detect accidental damage, such as flipped bits. They do not protect against someone who changes a file and its
checksums on purpose; such a file still executes nothing.

The format: 8 bytes of length, a JSON table of dtypes, shapes and offsets, the arrays. The safetensors library reads it,
without mapping the file into memory: a mapped file that shrinks ends the process. It cannot write an array at a time to an
open file, which saves copying a replay buffer and reports a full disk as ``OSError``; so files are written here.
"""

from __future__ import annotations

import contextlib
import json
import math
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from safetensors import SafetensorError, safe_open

from rejeu.core import atomic
from rejeu.core.errors import CheckpointError
from rejeu.core.hardware import physical_memory
from rejeu.core.records import Malformed, is_sparse, parse_json, shown, stored_size
from rejeu.core.types import PyTree
from rejeu.core.validation import as_path

DTYPES = {"F32": "float32", "F64": "float64", "I64": "int64", "I32": "int32", "I16": "int16", "I8": "int8"}
DTYPES |= {"U64": "uint64", "U32": "uint32", "U16": "uint16", "U8": "uint8", "BOOL": "bool", "F16": "float16"}
"""The dtypes that are read and written, by their names in the format."""
MAX_TABLE = 4 * 2**20
"""Upper limit on the bytes of a table."""
METADATA = "__metadata__"


class ArraySpec(NamedTuple):
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


def specs_of(file: Any) -> dict[str, ArraySpec]:
    """Returns shape and dtype of each array of an open safetensors file by name, in the order of the offsets.

    Raises:
        Malformed: for dtypes that rejeu does not write.
    """
    specs = {}
    for name in file.offset_keys():
        array = file.get_slice(name)
        if (dtype := array.get_dtype()) not in DTYPES:
            raise Malformed(f"{shown(name)} has the dtype {shown(dtype)}, which rejeu does not write")
        specs[name] = ArraySpec(tuple(array.get_shape()), np.dtype(DTYPES[dtype]))
    return specs


def check_table(path: Path) -> None:
    """Raises ``Malformed`` if the table of a file is too large: the objects built from it could take gigabytes."""
    with path.open("rb") as file:
        size = int.from_bytes(file.read(8), "little")
    if size > MAX_TABLE:
        raise Malformed(f"its table has {size} bytes, expected at most {MAX_TABLE}")


def contiguous(name: str, value: object) -> np.ndarray:
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


SUFFIX = ".safetensors"
FOREIGN = (".zip", ".pkl")
"""Suffixes that Stable-Baselines3 gives its files; where a script asks for one, ours of that name is read."""
SCHEMA = 2
"""Version of the header's layout; raised when it changes."""
HEADER_KEY, CHECKSUM_KEY = "rejeu", "crc32"
"""Names of the header and of its checksum in the file's metadata."""
CHECKSUMS = "checksums"
"""Name of the arrays' checksums in the header."""
RESERVED = ("schema", "kind", CHECKSUMS)

Header = dict[str, Any]


def resolve(path: str | Path, suffix: str = SUFFIX) -> Path:
    """Returns the path with ``suffix`` added if it has none, as Stable-Baselines3 adds ``.zip``.

    Raises:
        ValueError: if it does not name a file, as ``""``, ``"."`` and ``"/"`` do not.
        TypeError: if it is no path.
    """
    path = as_path(path)
    if path.name in ("", ".."):
        raise ValueError(f"{str(path)!r} is not the path of a file; give one, such as 'model{SUFFIX}'")
    return path if path.suffix else path.with_name(path.name + suffix)


def write(path: str | Path, file_type: str, arrays: Mapping[str, object], header: Mapping[str, object]) -> Path:
    """Writes a file and returns its path; an existing file is replaced only once the new one is on disk.

    Arrays are converted and written one at a time, so that no second copy of a replay buffer is made.

    Args:
        path: of the file; ``.safetensors`` is added if it has no suffix, and missing folders are created.
        file_type: of the content, which :func:`read` asks for.
        arrays: by name, of the dtypes in ``DTYPES``.
        header: JSON values by name; finite numbers only.

    Raises:
        OSError: if the file cannot be written, with the reason and what to do; an old file is then unchanged.
        ValueError: if the header is not valid JSON or too large.
        TypeError: if a value of the header is not JSON, or for arrays of other dtypes.
    """
    path = resolve(path)
    if reserved := [key for key in RESERVED if key in header]:
        raise ValueError(f"the header may not have a {reserved[0]!r} of its own; choose another name")
    sums = {name: _checksum(contiguous(name, value)) for name, value in arrays.items()}
    text = json.dumps({"schema": SCHEMA, "kind": file_type, **header, CHECKSUMS: sums}, allow_nan=False)
    start, names = table(arrays, {HEADER_KEY: text, CHECKSUM_KEY: _text_checksum(text)})
    with atomic.replacing(path) as file:
        file.write(start)
        for name in names:
            file.write(as_bytes(contiguous(name, arrays[name])))
    return path


@dataclass(frozen=True)
class Contents:
    """An open file: its header, and the specs of its arrays, which are compared with what is expected before any is read."""

    path: Path
    file: Any
    """Of the safetensors library."""
    header: Header
    """Of the current schema."""
    specs: dict[str, ArraySpec]
    """Shape and dtype of each array, by name."""
    sums: dict[str, int]
    """Checksums of the arrays."""

    @property
    def room(self) -> int:
        """Bytes of the file; of a sparse file, without its holes."""
        return stored_size(self.path)

    def read(self, prefix: str = "") -> dict[str, np.ndarray]:
        """Returns the arrays whose names begin with ``prefix``, by their full names.

        Raises:
            CheckpointError: if one is damaged; it says which. Also for a sparse file that is nearly empty.
        """
        arrays = {}
        if is_sparse(self.path):
            raise CheckpointError(f"{self.path} is nearly empty, a large file of holes; restore it from a copy")
        with explained(self.path):
            for name in self.specs:
                if name.startswith(prefix):
                    arrays[name] = array = self.file.get_tensor(name)
                    if self.sums[name] != _checksum(contiguous(name, array)):
                        raise CheckpointError(
                            f"{self.path}: the array {shown(name)} is damaged (its checksum differs); restore the "
                            "file from a copy"
                        )
        return arrays


@contextlib.contextmanager
def opened(path: str | Path, file_type: str) -> Iterator[Contents]:
    """Opens a file of that type.

    Instead of a missing ``model.zip``, ``model.safetensors`` is opened, and the other way round. No array is read: a loader
    first compares ``specs`` with what it expects (:func:`match`), so that a file cannot make it read more than the model
    needs.

    Raises:
        FileNotFoundError: if there is no such file.
        CheckpointError: if it is not a complete rejeu file of that type; it says what is wrong.
    """
    with contextlib.ExitStack() as stack:
        with explained(path):
            path = existing(path)
            check_table(path)
            file = stack.enter_context(safe_open(path, framework="numpy", backend="pread"))
            specs = specs_of(file)
            header, sums = _head(path, file.metadata() or {}, {*specs}, file_type)
            size, memory = path.stat().st_size, physical_memory()
            if memory is not None and size > memory:
                raise CheckpointError(f"{path} has {size / 2**30:.1f} GiB and the machine {memory / 2**30:.1f} GiB")
        yield Contents(path, file, header, specs, sums)


def read(path: str | Path, file_type: str) -> tuple[Header, dict[str, np.ndarray]]:
    """Returns the header and all arrays, without comparing them with anything; loaders use :func:`opened`.

    Raises:
        FileNotFoundError: if there is no such file.
        CheckpointError: if it is not a complete, undamaged rejeu file of that type; it says what is wrong.
    """
    with opened(path, file_type) as file:
        return file.header, file.read()


def read_header(path: str | Path, file_type: str) -> Header:
    """Returns only the header of a file of that type; see :func:`opened`."""
    with opened(path, file_type) as file:
        return file.header


def match(expected: PyTree, arrays: Mapping[str, Any], path: str | Path) -> None:
    """Raises ``CheckpointError``, naming the first difference, unless arrays or specs match a tree of shapes.

    Args:
        expected: a tree whose leaves have a shape and a dtype.
        arrays: the arrays, or their specs, by name.
        path: of their file, for the message.
    """
    import jax  # here and below, so that a policy in NumPy starts without it

    from rejeu.core.algorithm import names

    keys = names(expected)
    for key, leaf in zip(keys, jax.tree.leaves(expected), strict=True):
        if key not in arrays:
            raise CheckpointError(f"{path} has no {key}; it was saved with other networks or another algorithm")
        if arrays[key].shape != leaf.shape or arrays[key].dtype != leaf.dtype:
            raise CheckpointError(
                f"{path}: {key} is {arrays[key].dtype}{shown(list(arrays[key].shape))}, expected "
                f"{leaf.dtype}{list(leaf.shape)}; it was saved with other networks or for another environment"
            )
    if extra := sorted({*arrays} - {*keys}):
        raise CheckpointError(
            f"{path} has {shown(extra[0])}, which this agent does not have; it was saved with another configuration"
        )


def within(arrays: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Returns the entries whose names begin with ``prefix``, which is removed."""
    return {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}


@contextlib.contextmanager
def explained(path: str | Path) -> Iterator[None]:
    """Turns errors of reading into ``CheckpointError`` with the path of the file."""
    shown_path = atomic.shortened(path)
    try:
        yield
    except (FileNotFoundError, CheckpointError):
        raise
    except (Malformed, SafetensorError) as error:
        advice = "it was cut short or is from another program"
        if zipfile.is_zipfile(path):
            advice = "it is a zip file; rejeu import converts those of Stable-Baselines3"
        with Path(path).open("rb") as file:
            is_pickle = file.read(1) == b"\x80"
        if is_pickle:
            advice = "it is a pickle, such as an old model of Stable Baselines 2, and no code of a file is run"
        raise CheckpointError(f"{shown_path} is not a complete safetensors file ({shown(error)}); {advice}") from None
    except OSError as error:
        raise CheckpointError(f"{shown_path} cannot be read: {error.strerror or error}") from None
    except MemoryError:
        raise CheckpointError(f"{shown_path} holds more than fits in memory") from None
    except ValueError as error:
        raise CheckpointError(str(error)) from None


def existing(path: str | Path) -> Path:
    """Returns the path of an existing file, of another suffix of models if it has none; raises as :func:`opened` does."""
    with explained(path):
        path = resolve(path)
        if path.suffix in (SUFFIX, *FOREIGN) and not path.exists():
            others = (path.with_suffix(suffix) for suffix in (SUFFIX, *FOREIGN))
            path = next((candidate for candidate in others if candidate.exists()), path)
        if not path.exists():
            raise FileNotFoundError(f"there is no file {path}")
        if not path.is_file():
            raise CheckpointError(f"{path} is not a file but a folder or a device; give the path of a file")
        return path


def _head(path: Path, metadata: Mapping[str, str], names: set[str], file_type: str) -> tuple[Header, dict[str, int]]:
    """Returns the header and the arrays' checksums, both verified."""
    text = metadata.get(HEADER_KEY)
    if text is None:
        raise CheckpointError(f"{path} is a safetensors file, but not one that rejeu wrote: its header is missing")
    header = _header(path, text, metadata.get(CHECKSUM_KEY))
    if header.get("kind") != file_type:
        raise CheckpointError(f"{path} holds {shown(header.get('kind'))!r}, expected {file_type!r}")
    sums = header.pop(CHECKSUMS, None)
    if not isinstance(sums, dict) or not all(type(value) is int for value in sums.values()):
        raise CheckpointError(f"{path}: the header holds no checksums; restore the file from a copy")
    if differing := names ^ sums.keys():
        raise CheckpointError(f"{path}: {shown(min(differing))} is among the arrays or the checksums, but not in both")
    return header, sums


def _header(path: Path, text: str, checksum: str | None) -> Header:
    def damaged(how: str) -> CheckpointError:
        return CheckpointError(f"{path}: the header is damaged ({how}); restore the file from a copy")

    try:
        header = parse_json(text)
    except Malformed as error:
        raise damaged(str(error)) from None
    if not isinstance(header, dict) or type(schema := header.get("schema")) is not int:
        raise damaged("it has no schema")
    if schema != SCHEMA:
        raise CheckpointError(
            f"{path} has schema {schema} and this rejeu reads schema {SCHEMA}; "
            + ("upgrade rejeu" if schema > SCHEMA else "it is from an unreleased version")
        )
    if checksum != _text_checksum(text):
        raise damaged("its checksum differs")
    return header


def _checksum(array: np.ndarray) -> int:
    """Returns the CRC-32 of an array's dtype, shape and contiguous bytes."""
    layout = f"{array.dtype.name}{list(array.shape)}".encode()
    return zlib.crc32(as_bytes(array), zlib.crc32(layout))


def _text_checksum(text: str) -> str:
    return f"{zlib.crc32(text.encode('utf-8', 'surrogatepass')):08x}"


def require_finite(arrays: Mapping[str, np.ndarray], path: str | Path) -> None:
    """Raises ``CheckpointError``, with the name, if an array holds NaN or infinities."""
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise CheckpointError(
                f"{path}: {shown(name)} holds numbers that are not finite: training had diverged when it was saved; "
                "load an earlier file"
            )


def tree_to_arrays(tree: PyTree) -> dict[str, np.ndarray]:
    """Returns the leaves of a tree by name, on the host."""
    import jax

    from rejeu.core.algorithm import names

    return dict(zip(names(tree), map(np.asarray, jax.tree.leaves(tree)), strict=True))


def arrays_to_tree(expected: PyTree, arrays: Mapping[str, np.ndarray], path: str | Path) -> PyTree:
    """Returns a tree like ``expected`` (of shapes) from arrays by name: the inverse of :func:`tree_to_arrays`.

    Raises:
        CheckpointError: unless names, shapes and dtypes are the same, naming the first that is not.
    """
    import jax

    from rejeu.core.algorithm import names

    match(expected, arrays, path)
    return jax.tree.unflatten(jax.tree.structure(expected), [arrays[key] for key in names(expected)])
