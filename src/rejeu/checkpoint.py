"""Files: arrays by name and a JSON header in one safetensors file, written atomically, read without running anything.

Reading builds every object from rejeu's own classes and from the caller's expectations; the file supplies numbers and
plain JSON values only, and names, shapes and dtypes must match. There is no second, laxer way to read.
"""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from rejeu.core import PyTree
from rejeu.errors import CheckpointError

SUFFIX = ".safetensors"
FOREIGN = (".zip", ".pkl")
"""Suffixes that Stable-Baselines3 gives its files; where a script asks for one, ours of that name is read."""
SCHEMA = 1
"""Version of the header's layout; raised when it changes."""
HEADER_KEY = "rejeu"
MAX_HEADER_BYTES = 16 * 2**20
DTYPES = {"F32": "float32", "F64": "float64", "I64": "int64", "I32": "int32", "I16": "int16", "I8": "int8"}
DTYPES |= {"U64": "uint64", "U32": "uint32", "U16": "uint16", "U8": "uint8", "BOOL": "bool"}


def resolve(path: str | Path) -> Path:
    """Returns the path with ``.safetensors`` added if it has no suffix, as Stable-Baselines3 adds ``.zip``."""
    path = Path(path)
    return path if path.suffix else path.with_name(path.name + SUFFIX)


def write(path: str | Path, kind: str, arrays: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> Path:
    """Writes one file and returns its path; what stood there before is replaced only once all is on disk.

    Raises:
        OSError: if the folder cannot be written; the old file is then untouched.
    """
    path = resolve(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"schema": SCHEMA, "kind": kind, **header}, allow_nan=False)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        temporary.touch()
        mode = temporary.stat().st_mode
        save_file({key: np.asarray(value, order="C") for key, value in arrays.items()}, temporary, {HEADER_KEY: text})
        temporary.chmod(mode)  # safetensors makes files that only their owner may read
        with temporary.open("r+b") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    return path


def read(path: str | Path, kind: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Returns header and arrays of a file of that ``kind`` (``"agent"``, ``"replay"`` or ``"vec_normalize"``).

    For ``model.zip``, where there is none, ``model.safetensors`` is read.

    Raises:
        FileNotFoundError: if there is no such file.
        CheckpointError: if it is not a complete rejeu file of that kind and schema.
    """
    path = resolve(path)
    if path.suffix in FOREIGN and not path.exists() and path.with_suffix(SUFFIX).exists():
        path = path.with_suffix(SUFFIX)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    try:
        with safe_open(path, framework="numpy") as file:
            header = _header(path, kind, (file.metadata() or {}).get(HEADER_KEY))
            arrays = {}
            for name in file.keys():  # noqa: SIM118 - the handle is no dict
                if file.get_slice(name).get_dtype() not in DTYPES:
                    raise CheckpointError(f"{path}: {name} has a dtype that rejeu does not write")
                arrays[name] = file.get_tensor(name)
    except (SafetensorError, OSError, ValueError, OverflowError) as error:
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(
            f"{path} is not a complete safetensors file ({error}); it was cut short or is of another program"
        ) from None
    return header, arrays


def _header(path: Path, kind: str, text: str | None) -> dict[str, Any]:
    if text is None:
        raise CheckpointError(f"{path} is a safetensors file, but not one that rejeu wrote: its header is missing")
    if len(text) > MAX_HEADER_BYTES:
        raise CheckpointError(f"{path}: the header is larger than {MAX_HEADER_BYTES} bytes")
    try:
        header = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError):
        raise CheckpointError(f"{path}: the header is damaged") from None
    if not isinstance(header, dict) or not isinstance(header.get("schema"), int):
        raise CheckpointError(f"{path}: the header is damaged")
    if header["schema"] != SCHEMA:
        raise CheckpointError(
            f"{path} has schema {header['schema']} and this rejeu reads schema {SCHEMA}; "
            + ("upgrade rejeu" if header["schema"] > SCHEMA else "it is of an unreleased version")
        )
    if header.get("kind") != kind:
        raise CheckpointError(f"{path} holds {str(header.get('kind'))[:40]!r}, expected {kind!r}")
    return header


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON number")


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
    keys, leaves = names(expected), jax.tree.leaves(expected)
    for key, leaf in zip(keys, leaves, strict=True):
        if key not in arrays:
            raise CheckpointError(f"{path} has no {key}; it was saved with other networks or another algorithm")
        found = arrays[key]
        if found.shape != leaf.shape or found.dtype != leaf.dtype:
            raise CheckpointError(
                f"{path}: {key} is {found.dtype}{list(found.shape)}, expected {leaf.dtype}{list(leaf.shape)}; "
                "it was saved with other networks or for another environment"
            )
    if extra := sorted(set(arrays) - set(keys)):
        raise CheckpointError(
            f"{path} has {extra[0]}, which this agent has not; it was saved with another configuration"
        )
    return jax.tree.unflatten(jax.tree.structure(expected), [arrays[key] for key in keys])
