"""One run on a node of a Ray cluster. This module is imported there, so it does not import JAX.

The node trains in the folder of the sweep if it sees it. Otherwise it trains in a folder of its own and sends what has changed
as an archive to the :class:`Storage`, a Ray actor next to the folder of the sweep: at every new checkpoint and at the end.
"""

from __future__ import annotations

import io
import json
import os
import platform
import shutil
import tarfile
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

from rejeu import cluster
from rejeu.experiments.process import Process
from rejeu.io import atomic

POLL = 0.2
"""Seconds between two looks at the process."""
ASK = 1.0
"""Seconds between two questions whether to stop, and two looks for a new checkpoint."""
GRACE = 300.0
"""Seconds after which a process that was asked to stop is killed."""
PACKAGES = ("jax", "jaxlib", "optax")
"""Further packages whose versions results depend on."""


class Spec(NamedTuple):
    """A run as a node trains it; paths are strings, of the machine of the sweep."""

    name: str
    task: str
    """File with what the process is asked to do."""
    content: dict[str, Any]
    """The same as JSON values."""
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


class Storage:
    """The folder of a sweep, for nodes that do not see it. Mutable; a Ray actor."""

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
        """Returns whether a run is asked to stop."""
        return name in self._stopping

    def fetch(self, name: str) -> bytes:
        """Returns the files of a run as an archive."""
        return archive(self._folder, files(self._folder, name))

    def put(self, name: str, content: bytes, kept: set[str]) -> None:
        """Writes the files of an archive in their order, and removes the other files of the run that are not ``kept``."""
        with tarfile.open(fileobj=io.BytesIO(content)) as opened:
            for member in opened:
                file, target = (
                    opened.extractfile(member),
                    self._folder / tarfile.data_filter(member, str(self._folder)).name,
                )
                atomic.make_folder(target.parent)
                with atomic.replacing(target) as written:
                    shutil.copyfileobj(file, written)  # type: ignore[arg-type]
        for path in files(self._folder, name).keys() - kept:
            (self._folder / path).unlink(missing_ok=True)


def files(folder: Path, name: str) -> dict[str, tuple[int, int]]:
    """Returns size and time of the last change of the log and of each complete file of a run, but not of locks.

    A checkpoint comes after the rows that it refers to. Files that the process removes meanwhile may be missing.
    """

    def order(path: Path) -> tuple[int, Path]:
        return 2 if path.name.startswith("run_") else 1 if path.parent.name == "checkpoints" else 0, path

    found = {}
    for path in sorted([folder / f"{name}.log", *(folder / name).rglob("*")], key=order):
        if path.is_file() and not path.is_symlink() and path.name != "lock" and path.name[0] != ".":
            now = path.stat()
            found[path.relative_to(folder).as_posix()] = (now.st_size, now.st_mtime_ns)
    return found


def archive(folder: Path, paths: Any) -> bytes:
    """Returns files in a folder as an uncompressed tar archive, in this order."""
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w") as opened:
        for path in paths:
            opened.add(folder / path, path)
    return content.getvalue()


class Copy:
    """The files of a run on this node, and what of them was sent. Mutable."""

    def __init__(self, name: str, folder: Path, storage: Any) -> None:
        self.name, self.folder, self.storage = name, folder, storage
        self._sent: dict[str, tuple[int, int]] = {}
        """Size and time of the last change of each file when it was sent."""

    def fetch(self) -> None:
        """Copies the run to this node."""
        with tarfile.open(fileobj=io.BytesIO(self.storage.fetch(self.name))) as opened:
            opened.extractall(self.folder, filter="data")
        self._sent = files(self.folder, self.name)

    def send(self, always: bool = True) -> None:
        """Sends what has changed; with ``always=False`` only if there is a new checkpoint.

        The process may remove old files meanwhile. Nothing is sent then, and all of it the next time.
        """
        try:
            found = files(self.folder, self.name)
            changed = [path for path, stamp in found.items() if self._sent.get(path) != stamp]
            if always or any(Path(path).name.startswith("run_") for path in changed):
                self.storage.put(self.name, archive(self.folder, changed), {*found})
                self._sent = found
        except FileNotFoundError:
            if always:
                raise


def train(spec: Spec, storage: Any) -> int:
    """Trains on this node until the process ends, and returns its exit status.

    Raises:
        ClusterError: if this node has other versions.
        OSError: if a file cannot be written here or there.
    """
    cluster.check_versions(cluster.versions(PACKAGES), f"the node {platform.node()}", spec.versions)
    if sees(spec.marker, spec.token):
        return watch(start(spec, Path(spec.task), Path(spec.log), Path(spec.lock)), spec, storage, None)
    folder = Path(tempfile.mkdtemp(prefix="rejeu-sweep-"))
    try:
        copy = Copy(spec.name, folder, storage)
        if spec.content["resume"]:
            copy.fetch()
        task = folder / "task"
        task.write_text(json.dumps({**spec.content, "folder": str(folder / spec.name)}), encoding="utf-8")
        status = watch(start(spec, task, folder / f"{spec.name}.log", folder / "lock"), spec, storage, copy)
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


def start(spec: Spec, task: Path, log: Path, lock: Path) -> Process:
    """Starts the process of a run, in the current folder of the sweep where this node has it."""
    folder = Path(spec.folder)
    return Process(task, log, lock, {**os.environ, **spec.environ}, folder if folder.is_dir() else None)


def watch(process: Process, spec: Spec, storage: Any, copy: Copy | None) -> int:
    """Waits for the end of a process and returns its exit status; stops it when asked, and sends new checkpoints.

    If this function is left by an error, such as the loss of the storage, the process stops as well.
    """
    asked, ask_at = 0.0, time.monotonic() + ASK
    try:
        while (status := process.poll()) is None:
            time.sleep(POLL)
            now = time.monotonic()
            if now >= ask_at:
                ask_at = now + ASK
                if not asked and storage.is_stopping(spec.name):
                    asked = now
                    process.stop()
                if copy is not None:
                    copy.send(always=False)
            if asked and now > asked + GRACE:
                process.kill()
        return status
    finally:
        process.stop()


class RemoteStorage:
    """A storage that is a Ray actor, called as an ordinary object."""

    def __init__(self, ray: Any, actor: Any) -> None:
        self._ray, self._actor = ray, actor

    def __getattr__(self, name: str) -> Any:
        return lambda *given: self._ray.get(getattr(self._actor, name).remote(*given))


def train_task(spec: Spec, actor: Any) -> int:
    """Calls :func:`train` in a Ray task."""
    import ray

    return train(spec, RemoteStorage(ray, actor))


def look(marker: str, token: str) -> tuple[dict[str, str], bool]:
    """Returns the versions of this node, and whether it sees the folder of the sweep."""
    return cluster.versions(PACKAGES), sees(marker, token)
