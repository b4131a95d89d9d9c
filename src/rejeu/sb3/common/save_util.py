"""Files given by path or already open, and plain values in them as JSON."""

from __future__ import annotations

import functools
import warnings
from pathlib import Path
from typing import Any

import msgspec

from rejeu.core import atomic

__all__ = [
    "load_from_pkl",
    "open_path",
    "open_path_pathlib",
    "open_path_str",
    "recursive_getattr",
    "recursive_setattr",
    "save_to_pkl",
]


def recursive_getattr(obj: Any, attr: str, *args: Any) -> Any:
    """Returns an attribute of an attribute: ``"policy.device"``; the optional third argument where there is none."""
    return functools.reduce(lambda one, name: getattr(one, name, *args), attr.split("."), obj)


def recursive_setattr(obj: Any, attr: str, val: Any) -> None:
    """Sets an attribute of an attribute."""
    parent, _, name = attr.rpartition(".")
    setattr(recursive_getattr(obj, parent) if parent else obj, name, val)


def open_path(path: Any, mode: str, verbose: int = 0, suffix: str | None = None) -> Any:
    """Returns a binary file, opened if it is given by a path.

    A missing folder is created. What is read may lack the ``suffix``; what is written gets it if it has none, and ``_2`` if
    there is a folder of that name.

    Args:
        path: a path, or a file object, which is returned.
        mode: ``"r"`` or ``"w"``.
        verbose: 2 warns of a suffix that was added to what is read, and of a file that is replaced.
        suffix: without the dot.

    Raises:
        TypeError: if it is neither a path nor a file.
        ValueError: for another mode, or a file that is closed or of the other mode.
    """
    if not isinstance(path, str | Path) and not hasattr(path, "read"):
        raise TypeError(f"path={path!r} must be a path or a file object")
    writes = {"w": True, "write": True, "r": False, "read": False}.get(str(mode).lower().removesuffix("b"))
    if writes is None:
        raise ValueError(f"mode={mode!r} must be 'r' or 'w'")
    if not isinstance(path, str | Path):
        if path.closed or not (path.writable() if writes else path.readable()):
            raise ValueError(f"the file is closed, or cannot be {'written' if writes else 'read'}")
        return path
    path = Path(path)
    longer = path.with_name(f"{path.name}.{suffix}") if suffix else path
    if not writes:
        if not path.exists() and longer.exists():
            if verbose >= 2:
                warnings.warn(f"Path {path!s} not found. Attempting {longer!s}.", UserWarning, stacklevel=2)
            path = longer
        return path.open("rb")
    path = path if path.suffix else longer
    if path.is_file() and verbose >= 2:
        warnings.warn(f"Path {path!s} exists and is replaced.", UserWarning, stacklevel=2)
    if path.is_dir():
        warnings.warn(f"Path {path!s} is a folder; writing {path!s}_2.", UserWarning, stacklevel=2)
        path = path.with_name(f"{path.name}_2")
    if not path.parent.exists():
        warnings.warn(f"Path {path.parent!s} does not exist and is created.", UserWarning, stacklevel=2)
        path.parent.mkdir(parents=True)
    return atomic.open_file(path, "wb")


open_path_pathlib = open_path_str = open_path


def save_to_pkl(path: Any, obj: Any, verbose: int = 0) -> None:
    """Writes numbers, texts, lists and dicts as JSON, since a file of rejeu's contains no objects.

    Raises:
        TypeError: for other objects; agents and replay buffers have methods of their own (``save``, ``save_replay_buffer``).
    """
    data = msgspec.json.encode(obj)
    file = open_path(path, "w", verbose, suffix="pkl")
    file.write(data)
    if file is not path:
        file.close()


def load_from_pkl(path: Any, verbose: int = 0) -> Any:
    """Returns what :func:`save_to_pkl` wrote; pickles are not read.

    Raises:
        ValueError: for another file.
    """
    file = open_path(path, "r", verbose, suffix="pkl")
    try:
        return msgspec.json.decode(file.read())
    except msgspec.DecodeError as error:
        raise ValueError(f"{path} was not written by save_to_pkl of rejeu: {error}") from None
    finally:
        if file is not path:
            file.close()
