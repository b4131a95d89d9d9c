"""One run on a node of a Ray cluster. This module is imported there, so it does not import JAX.

The node trains in the folder of the sweep if it sees it. Otherwise it trains in a folder of its own and sends new files to the
:class:`FileServer`, a Ray actor next to the folder of the sweep: at every new checkpoint and at the end.
"""

from __future__ import annotations

import os
import platform
import shutil
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from rejeu import cluster
from rejeu.io import atomic
from rejeu.sweeps.process import Process

POLL = 0.2
"""Seconds between two looks at the process."""
ASK = 1.0
"""Seconds between two questions whether to stop, and two looks for a new checkpoint."""
CHUNK = 2**24
"""Most bytes that are sent at once."""
GRACE = 300.0
"""Seconds after which a process that was asked to stop is killed."""
PACKAGES = ("jax", "jaxlib", "optax")
"""Further packages whose versions results depend on."""


class Spec(NamedTuple):
    """A run as a node trains it; paths are strings, of the machine of the sweep."""

    name: str
    words: tuple[str, ...]
    """Command line after ``rejeu``."""
    run: str
    """Its folder, which is also one of the words."""
    log: str
    lock: str
    marker: str
    """File that a node sees if it shares the folder of the sweep."""
    token: str
    """Content of that file."""
    folder: str
    """Current folder."""
    environ: dict[str, str]
    """Further environment variables."""
    versions: dict[str, str]
    """Versions that the node must have."""


class FileAccess(Protocol):
    """Access to the run folders on the machine of the sweep."""

    def is_stopping(self, name: str) -> bool:
        """Returns whether a run is asked to stop."""

    def listing(self, name: str) -> dict[str, int]:
        """Returns the files of a run folder and their sizes in bytes, by relative path."""

    def read(self, name: str, path: str, offset: int) -> bytes:
        """Returns up to ``CHUNK`` bytes of a file."""

    def write(self, name: str, path: str, offset: int, content: bytes, is_last: bool) -> None:
        """Writes a part of a file, which replaces the present one with its last part."""

    def remove(self, name: str, paths: list[str]) -> None:
        """Removes files of a run folder."""

    def append_log(self, name: str, content: bytes) -> None:
        """Appends to the log of a run."""


class FileServer:
    """Reads and writes the run folders of a sweep for nodes that do not see them. Mutable; a Ray actor."""

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder)
        self._stopping: set[str] = set()

    def stop(self, name: str) -> None:
        """Asks a run to stop."""
        self._stopping.add(name)

    def start(self, name: str) -> None:
        """Forgets that a run was asked to stop."""
        self._stopping.discard(name)

    def is_stopping(self, name: str) -> bool:
        return name in self._stopping

    def listing(self, name: str) -> dict[str, int]:
        return files(self._folder / name)

    def read(self, name: str, path: str, offset: int) -> bytes:
        with self._path(name, path).open("rb") as file:
            file.seek(offset)
            return file.read(CHUNK)

    def write(self, name: str, path: str, offset: int, content: bytes, is_last: bool) -> None:
        target = self._path(name, path)
        target.parent.mkdir(parents=True, exist_ok=True)
        part = target.with_name(f".{target.name}.part")
        with part.open("r+b" if offset else "wb") as file:
            file.seek(offset)
            file.write(content)
            if is_last:
                file.flush()
                os.fsync(file.fileno())
        if is_last:
            part.replace(target)

    def remove(self, name: str, paths: list[str]) -> None:
        for path in paths:
            self._path(name, path).unlink(missing_ok=True)

    def append_log(self, name: str, content: bytes) -> None:
        with atomic.open_log(self._folder / f"{name}.log") as file:
            file.write(content)

    def _path(self, name: str, path: str) -> Path:
        """Returns the path of a file in a run folder; raises ``ValueError`` for one outside of it."""
        parts = Path(path).parts
        if Path(path).is_absolute() or not parts or ".." in parts or "/" in name or "\\" in name or name[:1] == ".":
            raise ValueError(f"{name}/{path} is no file of a run folder")
        return self._folder / name / path


def files(folder: Path) -> dict[str, int]:
    """Returns the complete files in a folder and its subfolders, and their sizes; the locks are left out."""
    found = {}
    for path in folder.rglob("*") if folder.is_dir() else ():
        with suppress(OSError):
            if path.is_file() and not path.is_symlink() and path.name != "lock" and path.name[0] != ".":
                found[path.relative_to(folder).as_posix()] = path.stat().st_size
    return found


class Copy:
    """A run folder on this node, and what of it was sent. Mutable."""

    def __init__(self, name: str, folder: Path, server: FileAccess) -> None:
        self.name, self.folder, self.server = name, folder, server
        self.run, self.log = folder / name, folder / f"{name}.log"
        self._sent: dict[str, tuple[int, int]] = {}
        """Size and time of the last change of each file when it was sent."""
        self._log_sent = 0
        self._checkpoint = ""

    def fetch(self) -> None:
        """Copies the run folder to this node."""
        for path, size in self.server.listing(self.name).items():
            target = self.run / path
            target.parent.mkdir(parents=True, exist_ok=True)
            with target.open("wb") as file:
                while (offset := file.tell()) < size:
                    part = self.server.read(self.name, path, offset)
                    if not part:
                        break
                    file.write(part)
            self._sent[path] = stamp(target)
        self._checkpoint = newest(self.run)

    def send_new_checkpoint(self) -> None:
        """Sends what has changed, if there is a new checkpoint."""
        checkpoint = newest(self.run)
        if checkpoint != self._checkpoint:
            self.send()
            self._checkpoint = checkpoint

    def send(self) -> None:
        """Sends what has changed: checkpoints after the rows that they refer to, and removals last.

        The process may remove old files meanwhile; those are skipped, and a newer checkpoint is sent next time.
        """
        self._send_log()
        found = files(self.run)
        for path in sorted(found, key=order):
            with suppress(FileNotFoundError):
                now = stamp(self.run / path)
                if self._sent.get(path) != now:
                    self._send_file(path)
                    self._sent[path] = now
        gone = [path for path in self._sent if path not in found]
        if gone:
            self.server.remove(self.name, gone)
            for path in gone:
                del self._sent[path]

    def _send_file(self, path: str) -> None:
        with (self.run / path).open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            offset, is_last = 0, False
            while not is_last:
                part = file.read(min(CHUNK, size - offset))
                is_last = offset + len(part) >= size or not part
                self.server.write(self.name, path, offset, part, is_last)
                offset += len(part)

    def _send_log(self) -> None:
        with suppress(FileNotFoundError), self.log.open("rb") as file:
            file.seek(self._log_sent)
            while part := file.read(CHUNK):
                self.server.append_log(self.name, part)
                self._log_sent += len(part)


def stamp(path: Path) -> tuple[int, int]:
    """Returns size and time of the last change of a file."""
    found = path.stat()
    return found.st_size, found.st_mtime_ns


def newest(run: Path) -> str:
    """Returns the name of the newest checkpoint in a run folder, empty if there is none."""
    return max((path.name for path in (run / "checkpoints").glob("run_*.safetensors")), default="")


def order(path: str) -> tuple[int, str]:
    """Returns the place of a file in the order of sending: a checkpoint comes after the rows that it refers to."""
    return 2 if Path(path).name.startswith("run_") else 1 if path.startswith("checkpoints/") else 0, path


def train(spec: Spec, server: FileAccess) -> int:
    """Trains on this node until the process ends, and returns its exit status.

    Raises:
        ClusterError: if this node has other versions.
        OSError: if a file cannot be written here or there.
    """
    cluster.check_versions(cluster.versions(PACKAGES), f"the node {platform.node()}", spec.versions)
    if sees(spec.marker, spec.token):
        process = start(spec, spec.words, Path(spec.log), Path(spec.lock))
        return watch(process, spec, server, None)
    folder = Path(tempfile.mkdtemp(prefix="rejeu-sweep-"))
    try:
        copy = Copy(spec.name, folder, server)
        if spec.words[0] == "resume":
            copy.fetch()
        words = tuple(str(copy.run) if word == spec.run else word for word in spec.words)
        status = watch(start(spec, words, copy.log, folder / "lock"), spec, server, copy)
        copy.send()
        return status
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def sees(marker: str, token: str) -> bool:
    """Returns whether this node sees the folder of the sweep."""
    try:
        return Path(marker).read_text(encoding="utf-8") == token
    except (OSError, UnicodeDecodeError):
        return False


def start(spec: Spec, words: Sequence[str], log: Path, lock: Path) -> Process:
    """Starts the process of a run, in the current folder of the sweep where this node has it."""
    environ = {**os.environ, **spec.environ}
    folder = Path(spec.folder)
    return Process(words, log, lock, environ, folder if folder.is_dir() else None)


def watch(process: Process, spec: Spec, server: FileAccess, copy: Copy | None) -> int:
    """Waits for the end of a process and returns its exit status; stops it when asked, and sends new checkpoints.

    If this function is left by an error, such as the loss of the server, the process stops as well.
    """
    asked, ask_at = 0.0, time.monotonic() + ASK
    try:
        while (status := process.poll()) is None:
            time.sleep(POLL)
            now = time.monotonic()
            if now >= ask_at:
                ask_at = now + ASK
                if not asked and server.is_stopping(spec.name):
                    asked = now
                    process.stop()
                if copy is not None:
                    copy.send_new_checkpoint()
            if asked and now > asked + GRACE:
                process.kill()
        return status
    finally:
        process.stop()


class RemoteFileServer:
    """A server that is a Ray actor, called as an ordinary object."""

    def __init__(self, ray: Any, actor: Any) -> None:
        self._ray, self._actor = ray, actor

    def is_stopping(self, name: str) -> bool:
        return bool(self._ray.get(self._actor.is_stopping.remote(name)))

    def listing(self, name: str) -> dict[str, int]:
        found: Mapping[str, int] = self._ray.get(self._actor.listing.remote(name))
        return dict(found)

    def read(self, name: str, path: str, offset: int) -> bytes:
        return bytes(self._ray.get(self._actor.read.remote(name, path, offset)))

    def write(self, name: str, path: str, offset: int, content: bytes, is_last: bool) -> None:
        self._ray.get(self._actor.write.remote(name, path, offset, content, is_last))

    def remove(self, name: str, paths: list[str]) -> None:
        self._ray.get(self._actor.remove.remote(name, paths))

    def append_log(self, name: str, content: bytes) -> None:
        self._ray.get(self._actor.append_log.remote(name, content))


def train_task(spec: Spec, actor: Any) -> int:
    """Calls :func:`train` in a Ray task."""
    import ray

    return train(spec, RemoteFileServer(ray, actor))


def look(marker: str, token: str) -> tuple[dict[str, str], bool]:
    """Returns the versions of this node, and whether it sees the folder of the sweep."""
    return cluster.versions(PACKAGES), sees(marker, token)
