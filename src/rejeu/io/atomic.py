"""Files that are there whole or not at all, whatever ends the process or the power in between."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

STALE = 3600.0
"""Seconds after its last change from which on a temporary file counts as left behind by a process that is no more."""

ADVICE = {
    errno.ENOSPC: "free some space, or give a path on another disk",
    errno.EDQUOT: "free some of your quota, or give a path on another disk",
    errno.EFBIG: "raise the limit on the size of files (ulimit -f), or give a path on another disk",
    errno.EACCES: "give a path that you may write to, or change the permissions of its folder",
    errno.EPERM: "give a path that you may write to, or change the permissions of its folder",
    errno.EROFS: "give a path on a disk that can be written",
    errno.ENOENT: "its folder was removed while the file was written; write it again",
    errno.ENOTDIR: "a part of the path is a file; give a path through folders only",
    errno.EEXIST: "a part of the path is a file; give a path through folders only",
    errno.EISDIR: "give a path that is no folder",
    errno.ENAMETOOLONG: "give a shorter name",
}
"""What to do about each kind of failure."""


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Gives a new file to write to, which takes the place of ``path`` once it is complete and on disk.

    Missing folders are made. If anything is raised, in here or by the caller, ``path`` is left as it was. Temporary files
    that processes which were killed left behind for ``path`` are removed.

    Raises:
        OSError: if it cannot be written, of the class that fits, with the path, the reason and what to do.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        if path.exists() and not path.is_file():
            raise OSError(errno.EISDIR, "there is a folder, or something else that is no file, of that name")
        make_folder(path.parent)
        remove_stale(path)
        try:
            with temporary.open("xb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise _explained(error, path) from error
    _sync_folder(path.parent)


def make_folder(path: Path) -> None:
    """Makes a folder, and those above it that are missing, and brings their names to disk; one that is there is left alone.

    Raises:
        OSError: if that is impossible.
    """
    missing = []
    while not path.is_dir():
        missing.append(path)
        if path == path.parent:
            break
        path = path.parent
    for folder in reversed(missing):
        folder.mkdir(exist_ok=True)
        _sync_folder(folder.parent)


def append(path: Path, content: bytes) -> None:
    """Adds bytes at the end of a file, all of them or none; they are not brought to disk at once.

    Raises:
        OSError: if that is impossible, as for :func:`replacing`; the file is then as long as before.
    """
    try:
        with path.open("r+b", buffering=0) as file:
            end = file.seek(0, os.SEEK_END)
            try:
                rest = memoryview(content)
                while rest:
                    rest = rest[file.write(rest) :]
            except BaseException:
                file.truncate(end)
                raise
    except OSError as error:
        raise _explained(error, path) from error


def remove_stale(path: Path, age: float = STALE) -> None:
    """Removes temporary files of :func:`replacing` for ``path`` that nothing has written to for ``age`` seconds."""
    ours = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]{{8}}\.tmp")
    with contextlib.suppress(OSError):
        for other in path.parent.iterdir():
            if ours.fullmatch(other.name):
                with contextlib.suppress(OSError):
                    if time.time() - other.lstat().st_mtime > age:
                        other.unlink()


def shortened(path: str | Path) -> str:
    """Returns a path for a message: whole, unless it is longer than a line or two."""
    text = str(path)
    return text if len(text) <= 300 else f"{text[:150]}...{text[-50:]}"


def _sync_folder(folder: Path) -> None:
    """Brings the new name to disk where folders can be opened for that; elsewhere the system does so in its own time."""
    if os.name != "posix":
        return
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _explained(error: OSError, path: Path) -> OSError:
    """Returns an error of the same class whose message holds path, reason and remedy."""
    reason = error.strerror or str(error)
    advice = ADVICE.get(error.errno or 0, "give a path on another disk")
    return OSError(
        error.errno or errno.EIO, f"{shortened(path)} could not be written: {reason}; {advice}; nothing was replaced"
    )
