"""Finding and reading runs, of rejeu and of :mod:`other programs <rejeu.lab.reporting.other_programs>`."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core.errors import MissingExtra
from rejeu.core.records import shown
from rejeu.core.validation import as_path
from rejeu.lab.reporting.other_programs import EVENTS, FILES, MONITOR, files, read_monitor, read_tensorboard
from rejeu.lab.runs.read import MAX_NAME, RunSummary, is_file, read_run

MAX_DEPTH = 4
"""Levels of folders that are searched for runs."""
MAX_RUNS = 10_000
SKIPPED = {"checkpoints", "videos", "node_modules", "__pycache__"}


def read(path: str | Path, table_only: bool = False) -> RunSummary:
    """Returns the run in a folder, or of a ``monitor.csv``, whichever program wrote it.

    Args:
        path: a run folder of rejeu, a folder with ``monitor.csv`` or TensorBoard files, or a ``monitor.csv``.
        table_only: read of the episodes only what comparisons need: step, return and time.

    Raises:
        FileNotFoundError: if there is no run.
        ValueError: if a file is not what its name says.
    """
    path = as_path(path)
    if os.path.isdir(path):
        os.lstat(os.path.join(path, "."))  # raises an error that says why nothing in it can be read
    if path.is_file() and MONITOR.fullmatch(path.name):
        return read_monitor(path)
    if not path.is_dir() or is_ours(path):
        return read_run(path, ("step", "return", "seconds") if table_only else None)
    if files(path, MONITOR):
        return read_monitor(path)
    if files(path, EVENTS):
        return read_tensorboard(path)
    return read_run(path)


def read_all(paths: str | Path | RunSummary | Iterable[str | Path | RunSummary]) -> tuple[list[RunSummary], list[str]]:
    """Returns the runs of several paths, and notes about what could not be read.

    A folder that is no run itself is searched for run folders.

    Raises:
        FileNotFoundError: if a path does not exist, or holds no run.
    """
    sources: dict[object, Path | RunSummary] = {}
    for source in [paths] if isinstance(paths, str | RunSummary) or not isinstance(paths, Iterable) else paths:
        if isinstance(source, RunSummary):
            sources[source] = source
            continue
        inside = find(as_path(source))
        if not inside:
            raise FileNotFoundError(
                f"{shown(source, 300)} holds no run; expected a run folder of rejeu train, a monitor.csv or TensorBoard files"
            )
        for path in inside:
            sources.setdefault(path.resolve(), path)
    with ThreadPoolExecutor(2) as pool:  # NumPy computes outside of Python's lock
        read = [*pool.map(read_or_note, sources.values())]
    notes = [note for note in read if isinstance(note, str)]
    runs = distinct([run for run in read if isinstance(run, RunSummary)])
    notes += [f"{run.name}: {note}" for run in runs for note in run.notes if "damaged" in note]
    return runs, notes


def distinct(runs: list[RunSummary]) -> list[RunSummary]:
    """Returns the runs; those of the same name, such as ``seed_0``, get the name of the folder above in front of it."""
    counts = Counter(run.name for run in runs)

    def longer(run: RunSummary) -> RunSummary:
        return replace(run, name=shown(f"{run.path.parent.name}/{run.name}", MAX_NAME))

    return [longer(run) if counts[run.name] > 1 else run for run in runs]


def read_or_note(path: Path | RunSummary) -> RunSummary | str:
    """Returns a run as comparisons need it, or a note if it cannot be read."""
    try:
        return path if isinstance(path, RunSummary) else read(path, table_only=True)
    except (OSError, ValueError, MissingExtra) as error:
        return shown(f"{path} is left out: {error}", 300)


def find(path: Path) -> list[Path]:
    """Returns the runs at or below a path, sorted, and folders that cannot be read; symbolic links below it are not followed.

    Raises:
        FileNotFoundError: if the path does not exist.
    """
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise FileNotFoundError(f"there is no run folder {shown(path, 300)}")
    runs: list[Path] = []
    for root, names, _ in os.walk(path, onerror=lambda error: runs.append(Path(error.filename))):
        folder = Path(root)
        if is_run(folder) or not os.access(folder, os.X_OK):
            runs.append(folder)
        depth = len(folder.relative_to(path).parts)
        is_searched = folder not in runs[-1:] and depth < MAX_DEPTH and len(runs) < MAX_RUNS
        names[:] = sorted(name for name in names if name not in SKIPPED and name[0] != ".") if is_searched else []
    return sorted(runs)


def is_ours(folder: Path) -> bool:
    """Returns whether a folder is one of ``rejeu train``."""
    return any(map(is_file, RunFolder(folder).marks))


def is_run(folder: Path) -> bool:
    """Returns whether a folder is a run of any known program."""
    try:
        return is_ours(folder) or any(files(folder, pattern) for pattern in FILES)
    except OSError:
        return False
