"""Files: arrays by name and a JSON header in one safetensors file, written atomically, read without running anything.

Reading builds every object from rejeu's own classes and from the caller's expectations; the file supplies numbers and
plain JSON values only, and names, shapes and dtypes must match. There is no second, laxer way to read. What a file holds
and what is promised of it is said in ``docs/file-format.md``.

Checksums tell damage by chance: any few bits that flip are noticed. They are no protection against someone who changes a
file on purpose and the checksums with it; against that, nothing in a file is ever run.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import jax
import numpy as np

from rejeu.buffers.ram import physical_memory
from rejeu.core import PyTree
from rejeu.errors import CheckpointError
from rejeu.io import atomic, tensors
from rejeu.io.tensors import DTYPES, Entry, Malformed, Spec, Table, shown

SUFFIX = ".safetensors"
FOREIGN = (".zip", ".pkl")
"""Suffixes that Stable-Baselines3 gives its files; where a script asks for one, ours of that name is read."""
SCHEMA = 2
"""Version of the header's layout; raised when it changes, with a function in ``MIGRATIONS``."""
HEADER_KEY, CHECKSUM_KEY = "rejeu", "crc32"
"""Where the header, and the checksum of its text, stand among the file's metadata."""
CHECKSUMS = "checksums"
"""Where the header holds the checksum of each array, by name."""
MOST_PARTS = 1000
"""Parts between holes up to which the bytes of a file are counted; one of more counts as if it had no holes."""
RESERVED = ("schema", "kind", CHECKSUMS)

Header = dict[str, Any]


def _from_1(header: Header) -> Header:
    """Schema 2 added the checksums, which are checked before a header comes here; the rest is as it was."""
    return {**header, "schema": 2}


MIGRATIONS: dict[int, Callable[[Header], Header]] = {1: _from_1}
"""For every older schema, a pure function from its header to that of the next one."""


def resolve(path: str | Path) -> Path:
    """Returns the path with ``.safetensors`` added if it has no suffix, as Stable-Baselines3 adds ``.zip``.

    Raises:
        ValueError: if it does not name a file, as ``""``, ``"."`` and ``"/"`` do not.
    """
    if (given := Path(path)).name in ("", ".."):
        raise ValueError(f"{str(path)!r} is not the path of a file; give one, such as 'model{SUFFIX}'")
    path = given
    return path if path.suffix else path.with_name(path.name + SUFFIX)


def write(path: str | Path, kind: str, arrays: Mapping[str, Any], header: Mapping[str, Any]) -> Path:
    """Writes one file and returns its path; what stood there before is replaced only once all is on disk.

    Args:
        path: where; ``.safetensors`` is added if it has no suffix, and missing folders are made.
        kind: what it holds, which :func:`read` asks for.
        arrays: numbers by name, of any dtype among ``DTYPES``.
        header: JSON values by name; finite numbers only.

    Raises:
        OSError: if it cannot be written, with the reason and what to do; the old file is then untouched.
        ValueError: if the header holds what is no JSON, or more than is read again.
        TypeError: likewise, and for arrays of other dtypes.
    """
    path = resolve(path)
    if taken := [key for key in RESERVED if key in header]:
        raise ValueError(f"the header may not have a {taken[0]!r} of its own; name it otherwise")
    sums = {name: _checksum(tensors.plain(name, value)) for name, value in arrays.items()}
    text = json.dumps({"schema": SCHEMA, "kind": kind, **header, CHECKSUMS: sums}, allow_nan=False)
    tensors.parse_json(text)
    entries = tensors.layout(arrays)
    start = tensors.table_bytes(entries, {HEADER_KEY: text, CHECKSUM_KEY: _text_checksum(text)})
    with atomic.replacing(path) as file:
        file.write(start)
        for entry in entries:
            file.write(tensors.as_bytes(tensors.plain(entry.name, arrays[entry.name])))
    return path


class Contents:
    """A file that is open: its header, and which arrays it holds, to be compared with what is expected before any is read."""

    def __init__(self, path: Path, file: BinaryIO, header: Header, sums: dict[str, int] | None, table: Table) -> None:
        self.path = path
        self.header = header
        """That of the present schema."""
        self.specs = {entry.name: Spec(entry.shape, np.dtype(DTYPES[entry.dtype])) for entry in table.entries}
        """Shape and dtype of each array, by name."""
        self._file, self._sums, self._table = file, sums, table

    @property
    def room(self) -> int:
        """Bytes that the file holds, holes left out where the system tells them."""
        return _without_holes(self._file)

    def read(self, prefix: str = "") -> dict[str, np.ndarray]:
        """Returns the arrays whose names begin so, by their whole names.

        Raises:
            CheckpointError: if one is damaged; it says which.
        """
        arrays = {}
        with _explained(self.path):
            for entry in self._table.entries:
                if entry.name.startswith(prefix):
                    self._file.seek(self._table.start + entry.begin)
                    arrays[entry.name] = array = tensors.read_array(self._file, entry)
                    if self._sums is not None and self._sums[entry.name] != _checksum(tensors.plain(entry.name, array)):
                        raise CheckpointError(
                            f"{self.path}: the array {shown(entry.name)} is damaged (its checksum differs); restore the "
                            "file from a copy"
                        )
        return arrays


@contextlib.contextmanager
def opened(path: str | Path, kind: str) -> Iterator[Contents]:
    """Gives the contents of a file of that ``kind``; headers of older schemas come as those of the present one.

    For ``model.zip``, where there is none, ``model.safetensors`` is read. No array is read: a loader first compares
    ``specs`` with what it expects (:func:`match`), so that a file cannot make it read more than the model needs.

    Raises:
        FileNotFoundError: if there is no such file.
        CheckpointError: if it is not a complete rejeu file of that kind; it says what is wrong.
    """
    with contextlib.ExitStack() as stack:
        with _explained(path):
            path = _existing(path)
            file = stack.enter_context(path.open("rb"))
            size = os.fstat(file.fileno()).st_size
            header, sums, table = _head(path, file, size, kind)
            memory = physical_memory()
            if memory is not None and size > memory:
                raise CheckpointError(f"{path} has {size / 2**30:.1f} GiB and the machine {memory / 2**30:.1f} GiB")
        yield Contents(path, file, _migrated(path, header), sums, table)


def read(path: str | Path, kind: str) -> tuple[Header, dict[str, np.ndarray]]:
    """Returns header and all arrays, whatever they are: for files that are known to be good. Loaders use :func:`opened`.

    Raises:
        FileNotFoundError: if there is no such file.
        CheckpointError: if it is not a complete, undamaged rejeu file of that kind; it says what is wrong.
    """
    with opened(path, kind) as file:
        return file.header, file.read()


def read_header(path: str | Path, kind: str) -> Header:
    """Returns the header alone of a file of that ``kind``; see :func:`opened`."""
    with opened(path, kind) as file:
        return file.header


def match(expected: PyTree, found: Mapping[str, Any], path: str | Path) -> None:
    """Raises ``CheckpointError`` unless arrays, or their specs, are those of a tree of shapes; it names the first that is not.

    Args:
        expected: a tree whose leaves have a shape and a dtype.
        found: arrays or specs by name.
        path: where they are from, for the message.
    """
    keys = names(expected)
    for key, leaf in zip(keys, jax.tree.leaves(expected), strict=True):
        if key not in found:
            raise CheckpointError(f"{path} has no {key}; it was saved with other networks or another algorithm")
        if found[key].shape != leaf.shape or found[key].dtype != leaf.dtype:
            raise CheckpointError(
                f"{path}: {key} is {found[key].dtype}{shown(list(found[key].shape))}, expected "
                f"{leaf.dtype}{list(leaf.shape)}; it was saved with other networks or for another environment"
            )
    if extra := sorted({*found} - {*keys}):
        raise CheckpointError(
            f"{path} has {shown(extra[0])}, which this agent has not; it was saved with another configuration"
        )


def within(found: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Returns the entries whose names begin so, by the rest of their names."""
    return {name.removeprefix(prefix): value for name, value in found.items() if name.startswith(prefix)}


def _existing(path: str | Path) -> Path:
    """Returns the path of a file that is there, as :func:`opened` looks for it."""
    path = resolve(path)
    if path.suffix in FOREIGN and not path.exists() and path.with_suffix(SUFFIX).exists():
        path = path.with_suffix(SUFFIX)
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    if not path.is_file():
        raise CheckpointError(f"{path} is no file but a folder or a device; give the path of a file")
    return path


def _without_holes(file: BinaryIO) -> int:
    """Returns the size of a file, holes left out where the system tells them; where it stands is not changed."""
    handle = file.fileno()
    size, place = os.fstat(handle).st_size, os.lseek(handle, 0, os.SEEK_CUR)
    if not hasattr(os, "SEEK_DATA"):
        return size
    total = end = 0
    try:
        for _ in range(MOST_PARTS):
            begin = os.lseek(handle, end, os.SEEK_DATA)
            end = os.lseek(handle, begin, os.SEEK_HOLE)
            total += end - begin
        return size
    except OSError as error:
        return total if error.errno == errno.ENXIO else size  # no data are left, or holes cannot be told
    finally:
        os.lseek(handle, place, os.SEEK_SET)


@contextlib.contextmanager
def _explained(path: str | Path) -> Iterator[None]:
    """Says of whatever goes wrong with a file which file it was."""
    shown_path = atomic.shortened(path)
    try:
        yield
    except FileNotFoundError:
        raise
    except Malformed as error:
        raise CheckpointError(
            f"{shown_path} is not a complete safetensors file ({error}); it was cut short or is of another program"
        ) from None
    except OSError as error:
        raise CheckpointError(f"{shown_path} cannot be read: {error.strerror or error}") from None
    except MemoryError:
        raise CheckpointError(f"{shown_path} holds more than there is memory for") from None
    except CheckpointError:
        raise
    except ValueError as error:
        raise CheckpointError(str(error)) from None


def _head(path: Path, file: BinaryIO, size: int, kind: str) -> tuple[Header, dict[str, int] | None, Table]:
    """Returns header, the arrays' checksums (None of schema 1, which has none) and the table, all checked."""
    table = tensors.read_table(file, size)
    text = table.metadata.get(HEADER_KEY)
    if text is None:
        raise CheckpointError(f"{path} is a safetensors file, but not one that rejeu wrote: its header is missing")
    for entry in table.entries:
        if entry.dtype not in DTYPES:
            raise CheckpointError(f"{path}: {shown(entry.name)} has a dtype that rejeu does not write")
    header = _header(path, text, table.metadata.get(CHECKSUM_KEY))
    if header.get("kind") != kind:
        raise CheckpointError(f"{path} holds {shown(header.get('kind'))!r}, expected {kind!r}")
    sums = header.pop(CHECKSUMS, None)
    if header["schema"] == 1:
        return header, None, table
    _check_named(path, table.entries, sums)
    return header, sums, table


def _header(path: Path, text: str, checksum: str | None) -> Header:
    def damaged(how: str) -> CheckpointError:
        return CheckpointError(f"{path}: the header is damaged ({how}); restore the file from a copy")

    try:
        header = tensors.parse_json(text)
    except Malformed as error:
        raise damaged(str(error)) from None
    if not isinstance(header, dict) or type(schema := header.get("schema")) is not int:
        raise damaged("it has no schema")
    if schema > SCHEMA or schema < 1:
        raise CheckpointError(
            f"{path} has schema {schema} and this rejeu reads schemas 1 to {SCHEMA}; "
            + ("upgrade rejeu" if schema > SCHEMA else "it is of an unreleased version")
        )
    if (schema > 1 or checksum is not None) and checksum != _text_checksum(text):
        raise damaged("its checksum differs")
    return header


def _check_named(path: Path, entries: list[Entry], sums: Any) -> None:
    if not isinstance(sums, dict) or not all(type(value) is int for value in sums.values()):
        raise CheckpointError(f"{path}: the header holds no checksums; restore the file from a copy")
    if differing := {entry.name for entry in entries} ^ sums.keys():
        raise CheckpointError(f"{path}: {shown(min(differing))} is among the arrays or the checksums, but not in both")


def _migrated(path: Path, header: Header) -> Header:
    """Returns a header of the present schema from one of any that was released."""
    try:
        while header["schema"] < SCHEMA:
            header = MIGRATIONS[header["schema"]](header)
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise CheckpointError(f"{path}: the header of schema {header['schema']} is damaged: {shown(error)}") from None
    return header


def _checksum(array: np.ndarray) -> int:
    """Returns the CRC-32 of an array's dtype, shape and contiguous bytes."""
    kind = f"{array.dtype.name}{list(array.shape)}".encode()
    return zlib.crc32(tensors.as_bytes(array), zlib.crc32(kind))


def _text_checksum(text: str) -> str:
    return f"{zlib.crc32(text.encode('utf-8', 'surrogatepass')):08x}"


def require_finite(arrays: Mapping[str, np.ndarray], path: str | Path) -> None:
    """Raises ``CheckpointError``, with the name, if an array holds infinities or what is no number."""
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise CheckpointError(
                f"{path}: {shown(name)} holds numbers that are not finite: training had diverged when it was saved; "
                "load an earlier file"
            )


def names(tree: PyTree) -> list[str]:
    """Returns the dotted path of each leaf of a tree, such as ``actor.torso.layers.0.weight``."""
    return [
        jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in jax.tree_util.tree_leaves_with_path(tree)
    ]


def tree_to_arrays(tree: PyTree) -> dict[str, np.ndarray]:
    """Returns the leaves of a tree by name, on the host."""
    return dict(zip(names(tree), map(np.asarray, jax.tree.leaves(tree)), strict=True))


def arrays_to_tree(expected: PyTree, arrays: Mapping[str, np.ndarray], path: str | Path) -> PyTree:
    """Returns a tree like ``expected`` (of shapes) from arrays by name: the inverse of :func:`tree_to_arrays`.

    Raises:
        CheckpointError: unless names, shapes and dtypes are the same, naming the first that is not.
    """
    match(expected, arrays, path)
    return jax.tree.unflatten(jax.tree.structure(expected), [arrays[key] for key in names(expected)])
