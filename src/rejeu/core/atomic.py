"""Atomic writes: after a crash or power cut a file is either complete or unchanged."""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import re
import secrets
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, BinaryIO

from rejeu.core import interrupt

if TYPE_CHECKING:
    from filelock import FileLock

STALE = 3600.0
"""Age in seconds from which a temporary file is taken for one that a killed process left behind."""

NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
"""Flags with which neither a symbolic link is followed nor a pipe is waited for, on systems that have them."""

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
    errno.EISDIR: "give a path that is not a folder",
    errno.ENAMETOOLONG: "give a shorter name",
}
"""The advice for each error."""


def replace_patiently(source: Path, target: Path, waits: Iterable[float] = (0.01, 0.04, 0.2, 0.75)) -> None:
    """Renames a file over another one, which on Windows fails while a reader holds it: waits up to a second for that."""
    for seconds in waits:
        with contextlib.suppress(PermissionError):
            source.replace(target)
            return
        time.sleep(seconds)
    source.replace(target)


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Opens a new file for writing, which replaces ``path`` once it is complete and on disk.

    Missing folders are created. If an exception is raised, ``path`` is unchanged. Temporary files that killed processes left
    behind for ``path`` are removed.

    Raises:
        OSError: if it cannot be written, of the matching class, with the path, the reason and what to do.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        if path.exists() and not path.is_file():
            raise OSError(errno.EISDIR, "there is a folder, or something else that is not a file, of that name")
        make_folder(path.parent)
        remove_stale(path)
        interrupt.unfinished.add(temporary)
        try:
            with temporary.open("xb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            (Path.replace if os.name == "posix" else replace_patiently)(temporary, path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
        finally:
            interrupt.unfinished.discard(temporary)
    except OSError as error:
        raise _explained(error, path) from error
    _sync_folder(path.parent)


def write(path: Path, content: bytes | str) -> Path:
    """Writes a file, as :func:`replacing` does, and returns its path; text as UTF-8."""
    with replacing(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)
    return path


def make_folder(path: Path) -> None:
    """Creates a folder with its missing parents and syncs their names to disk; an existing folder is not changed.

    Raises:
        OSError: if that is impossible.
    """
    missing = itertools.takewhile(lambda folder: not folder.is_dir(), (path, *path.parents))
    for folder in reversed([*missing]):
        folder.mkdir(exist_ok=True)
        _sync_folder(folder.parent)


def append(path: Path, content: bytes) -> None:
    """Appends bytes to a file, all of them or none; they are not synced to disk.

    Raises:
        OSError: if that is impossible, as for :func:`replacing`, or the path is a symbolic link; the file is then as long as
            before.
    """
    try:
        with open_file(path, "r+b", buffering=0) as file:
            end = file.seek(0, os.SEEK_END)
            try:
                remaining = memoryview(content)
                while remaining:
                    remaining = remaining[file.write(remaining) :]
            except BaseException:
                file.truncate(end)
                raise
    except OSError as error:
        raise _explained(error, path) from error


def open_file(path: str | Path, mode: str = "ab", **settings: Any) -> IO[Any]:
    """Opens a file for writing as ``open`` does, but follows no symbolic link; by default lines are added to it.

    Raises:
        OSError: if that is impossible, or the path is a symbolic link.
    """
    check_no_link(Path(path))
    return open(path, mode, opener=lambda name, flags: os.open(name, flags | NO_FOLLOW, 0o666), **settings)


def touch(path: Path) -> None:
    """Creates a file or renews its time, as :func:`open_file` opens it."""
    open_file(path).close()
    os.utime(path)


def lock(path: str | Path, timeout: float = -1) -> FileLock:
    """Returns the lock on a file, no symbolic link, made when it is acquired; ``timeout`` in seconds, negative for none."""
    from filelock import FileLock  # slow to import

    check_no_link(Path(path))
    return FileLock(path, timeout)


def check_no_link(path: Path) -> None:
    """Raises ``OSError`` if a path is a symbolic link, through which a folder from elsewhere could change any file."""
    if path.is_symlink():
        raise OSError(errno.ELOOP, f"{shortened(path)} is a symbolic link; remove it")


def check_no_links(folder: Path) -> None:
    """Raises ``OSError`` if a symbolic link in a folder, at any depth, leads out of it: before libraries write into it.

    Some of these make links inside of it, such as wandb's ``latest-run``.
    """
    inside = folder.resolve()
    for root, folders, names in os.walk(folder):
        for path in (Path(root, name) for name in (*folders, *names)):
            if path.is_symlink() and not path.resolve().is_relative_to(inside):
                check_no_link(path)


def remove_stale(path: Path, age: float = STALE) -> None:
    """Removes temporary files of :func:`replacing` for ``path`` that were last written ``age`` seconds ago or earlier."""
    ours = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]{{8}}\.tmp")
    with contextlib.suppress(OSError):
        for file in path.parent.iterdir():
            if ours.fullmatch(file.name):
                with contextlib.suppress(OSError):
                    if time.time() - file.lstat().st_mtime > age:
                        file.unlink()


def shortened(path: str | Path) -> str:
    """Returns a path for a message, shortened if it is very long."""
    text = str(path)
    return text if len(text) <= 300 else f"{text[:150]}...{text[-50:]}"


def _sync_folder(folder: Path) -> None:
    """Syncs the names in a folder to disk, on systems where folders can be opened."""
    if os.name != "posix":
        return
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _explained(error: OSError, path: Path) -> OSError:
    """Returns an error of the same class whose message contains the path, the reason and what to do."""
    reason = error.strerror or str(error)
    advice = ADVICE.get(error.errno or 0, "give a path on another disk")
    return OSError(
        error.errno or errno.EIO, f"{shortened(path)} could not be written: {reason}; {advice}; nothing was replaced"
    )
