"""Simulates power failures: generates every state of the files that POSIX allows after a sequence of file operations.

Operations are recorded while a program runs (:class:`Recorder`). A power failure can occur between any two of them. A
file then has its contents at the last ``fsync``. Of later writes, it has all, a part, zeros or nothing. A folder has
its names at the last ``fsync`` and any subset of the changes since then. Real file systems give stronger guarantees. A
program that is correct under these rules is therefore correct on all of them.
"""

import io
import itertools
import os
import pathlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

MOST_CHANGES = 8
"""Maximum number of unsynced name changes of which all subsets are generated. Of more, the first are used."""


class Operation(NamedTuple):
    """One operation on a file or folder."""

    kind: str
    """``create``, ``write``, ``sync``, ``sync folder``, ``rename``, ``remove``, ``folder`` or ``done``."""
    path: pathlib.PurePath
    more: Any = None
    """The bytes written, or the new path."""
    note: Any = None
    """Value of ``Recorder.note`` at the time of the operation."""


class Recorder:
    """Records operations of ``pathlib`` and ``os.fsync`` in a folder."""

    def __init__(self, monkeypatch: Any, root: pathlib.Path) -> None:
        self.root = root
        self.operations: list[Operation] = []
        self.note: Any = None
        """Value that is recorded with every following operation."""
        self._folders: dict[int, pathlib.Path] = {}
        self._files: dict[int, _File] = {}
        self._patch(monkeypatch)

    def add(self, kind: str, path: pathlib.Path, more: Any = None) -> None:
        """Records an operation if it is in the folder. Consecutive writes to the same file are merged."""
        if not path.is_relative_to(self.root):
            return
        path, last = path.relative_to(self.root), self.operations[-1] if self.operations else None
        if kind == "write" and last is not None and (last.kind, last.path) == (kind, path):
            self.operations[-1] = last._replace(more=last.more + more)  # partial writes are generated in any case
        else:
            self.operations.append(Operation(kind, path, more, self.note))

    def _patch(self, monkeypatch: Any) -> None:
        own, path_type = self, pathlib.Path
        open_, rename, replace, unlink, mkdir = (
            getattr(path_type, name) for name in ("open", "rename", "replace", "unlink", "mkdir")
        )
        os_open, os_close, fsync = os.open, os.close, os.fsync

        def recorded_open(path: pathlib.Path, mode: str = "r", *rest: Any, **keywords: Any) -> Any:
            if mode == "xb" and path.is_relative_to(own.root):
                return _File(path, own)
            assert not path.is_relative_to(own.root) or mode in ("r", "rb"), f"{mode} is not recorded"
            return open_(path, mode, *rest, **keywords)

        def moved(function: Callable[..., Any]) -> Callable[..., Any]:
            def move(path: pathlib.Path, target: Any) -> Any:
                own.add("rename", path, pathlib.Path(target).relative_to(own.root))
                return function(path, target)

            return move

        def recorded_unlink(path: pathlib.Path, missing_ok: bool = False) -> None:
            if path.exists():
                own.add("remove", path)
            unlink(path, missing_ok)

        def recorded_mkdir(path: pathlib.Path, *rest: Any, **keywords: Any) -> None:
            if not path.exists():
                assert path.parent.exists(), "every folder is made by a call of its own"
                own.add("folder", path)
            mkdir(path, *rest, **keywords)

        def recorded_os_open(path: Any, flags: int, *rest: Any, **keywords: Any) -> int:
            handle = os_open(path, flags, *rest, **keywords)
            if pathlib.Path(path).is_dir():
                own._folders[handle] = pathlib.Path(path)
            return handle

        def recorded_close(handle: int) -> None:
            own._folders.pop(handle, None)
            os_close(handle)

        def recorded_fsync(handle: int) -> None:
            fsync(handle)
            if handle in own._folders:
                own.add("sync folder", own._folders[handle])
            elif handle in own._files:
                own.add("sync", own._files[handle].path)

        for name, function in (
            ("open", recorded_open),
            ("rename", moved(rename)),
            ("replace", moved(replace)),
            ("unlink", recorded_unlink),
            ("mkdir", recorded_mkdir),
        ):
            monkeypatch.setattr(path_type, name, function)
        monkeypatch.setattr(os, "open", recorded_os_open)
        monkeypatch.setattr(os, "close", recorded_close)
        monkeypatch.setattr(os, "fsync", recorded_fsync)


class _File(io.FileIO):
    def __init__(self, path: pathlib.Path, recorder: Recorder) -> None:
        super().__init__(path, "xb")
        self.path, self._recorder = path, recorder
        recorder._files[self.fileno()] = self
        recorder.add("create", path)

    def write(self, content: Any) -> int:
        self._recorder.add("write", self.path, bytes(content))
        return super().write(content) or 0

    def close(self) -> None:
        if not self.closed:
            self._recorder._files.pop(self.fileno(), None)
        super().close()


class Inode:
    """A file or folder, independent of its name."""

    def __init__(self, is_folder: bool) -> None:
        self.is_folder = is_folder
        self.written, self.synced = b"", b""


class State(NamedTuple):
    """The files after a power failure."""

    files: dict[str, bytes]
    """Contents by path."""
    folders: list[str]
    note: Any
    """Note of the operation before which the power failed."""
    n_done: int
    """Number of preceding operations of the kind ``done``."""


Entries = dict[pathlib.PurePath, Inode]


def crash_states(operations: list[Operation], ignored: tuple[str, ...] = ()) -> Iterator[State]:
    """Yields every possible state after a power failure, each once, for any number of completed operations.

    Args:
        operations: the recorded operations.
        ignored: kinds of operations to omit, which shows what a program without them would lose.
    """
    names: Entries = {}
    synced: Entries = {}
    changes: list[tuple[pathlib.PurePath, Callable[[Entries], None]]] = []
    seen, n_done = set(), 0
    for i in range(len(operations) + 1):
        note = operations[min(i, len(operations) - 1)].note
        for state in _states(synced, changes):
            key = (frozenset(state[0].items()), tuple(state[1]), n_done)
            if key not in seen:
                seen.add(key)
                yield State(*state, note, n_done)
        if i == len(operations):
            break
        operation = operations[i]
        n_done += operation.kind == "done"
        if operation.kind not in ignored:
            _do(operation, names, synced, changes)


def _do(operation: Operation, names: Entries, synced: Entries, changes: list[Any]) -> None:
    kind, path, more = operation.kind, operation.path, operation.more
    change: Callable[[Entries], None] | None = None
    if kind in ("create", "folder"):
        inode = Inode(kind == "folder")
        change = lambda entries: entries.update({path: inode})  # noqa: E731
    elif kind == "write":
        names[path].written += more
    elif kind == "sync":
        names[path].synced = names[path].written
    elif kind == "remove":
        change = lambda entries: entries.pop(path, None) and None  # noqa: E731
    elif kind == "rename":
        inode = names[path]

        def change(entries: Entries) -> None:
            entries.pop(path, None)
            entries[more] = inode

    elif kind == "sync folder":
        for folder, one in list(changes):
            if folder == path:
                one(synced)
                changes.remove((folder, one))
    if change is not None:
        change(names)
        changes.append(((more if kind == "rename" else path).parent, change))


def _states(synced: Entries, changes: list[Any]) -> Iterator[tuple[dict[str, bytes], list[str]]]:
    for subset in _subsets(len(changes)):
        entries = dict(synced)
        for i in subset:
            changes[i][1](entries)
        there = {path: inode for path, inode in entries.items() if _is_reachable(path, entries)}
        folders = sorted(path.as_posix() for path, inode in there.items() if inode.is_folder)
        files = {path.as_posix(): inode for path, inode in there.items() if not inode.is_folder}
        open_ones = [name for name, inode in files.items() if inode.synced != inode.written]
        for after in ("nothing", "half", "zeros", "all") if open_ones else ("all",):
            yield {name: _content(inode, after) for name, inode in files.items()}, folders


def _subsets(n: int) -> Iterator[tuple[int, ...]]:
    every = range(min(n, MOST_CHANGES))
    for size in range(len(every) + 1):
        yield from itertools.combinations(every, size)
    yield from (tuple(range(size)) for size in range(MOST_CHANGES + 1, n + 1))


def _is_reachable(path: pathlib.PurePath, entries: Entries) -> bool:
    return all(parent in entries for parent in path.parents if parent != pathlib.PurePath("."))


def _content(inode: Inode, after: str) -> bytes:
    rest = inode.written[len(inode.synced) :]
    kept = {"nothing": b"", "half": rest[: len(rest) // 2], "zeros": bytes(len(rest)), "all": rest}[after]
    return inode.synced + kept


def make(state: State, root: pathlib.Path) -> None:
    """Writes the files of a state to an empty folder."""
    for folder in state.folders:
        (root / folder).mkdir(parents=True, exist_ok=True)
    for name, content in state.files.items():
        (root / name).write_bytes(content)
