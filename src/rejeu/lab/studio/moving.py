"""Runs that are renamed, or deleted, which moves them into a folder from which they come back."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core import atomic
from rejeu.lab.reporting.run_list import find
from rejeu.lab.runs.read import is_file, is_locked
from rejeu.lab.studio.new import check_new, new_folder
from rejeu.lab.studio.processes import log_of
from rejeu.lab.studio.state import Studio

BIN = ".bin"
"""Folder of the runs that were deleted, in the folder of the studio: for each time a folder, named after it."""


def rename(studio: Studio, run: str, name: str) -> None:
    """Gives a run another name below the folder of the studio.

    Raises:
        ValueError: if the name is invalid or taken, or the run trains.
        OSError: if it cannot be moved.
    """
    source, target = movable(studio, run), new_folder(studio, name)
    move(studio, source, target)
    if is_file(log := log_of(source)):
        atomic.check_no_link(log_of(target).parent)
        atomic.make_folder(log_of(target).parent)
        log.replace(log_of(target))


def delete(studio: Studio, runs: Sequence[str]) -> None:
    """Moves runs into a new folder below :data:`BIN`.

    Raises:
        ValueError: if one of them trains; then none is moved.
        OSError: if one cannot be moved.
    """
    sources = [movable(studio, run) for run in runs]
    atomic.check_no_link(studio.folder / BIN)
    folder = studio.folder / BIN / f"{time.strftime('%Y%m%d-%H%M%S')}-{time.time_ns() % 10**9:09}"
    studio.deleted.append(folder)
    for run, source in zip(runs, sources, strict=True):
        move(studio, source, folder / run)


def restore(studio: Studio) -> None:
    """Moves the runs that were deleted last back to where they were.

    Raises:
        ValueError: if there is something else now; the runs that were not moved stay in the bin.
        OSError: if one cannot be moved.
    """
    atomic.check_no_link(studio.folder / BIN)
    folder = studio.deleted[-1]
    for source in find(folder):
        target = studio.below(source.relative_to(folder).as_posix())
        check_new(target)
        move(studio, source, target)
    studio.deleted.pop()


def movable(studio: Studio, run: str) -> Path:
    """Returns the path of a run that may be moved.

    Raises:
        ValueError: if it trains, or is no run in the folder.
        OSError: if a folder of its path is a symbolic link.
    """
    path = studio.below(run)
    if studio.row(run) is None or not path.is_dir():
        raise ValueError(f"there is no run {run!r} in {studio.folder}")
    for folder in (path, *path.parents[: len(Path(run).parts) - 1]):
        atomic.check_no_link(folder)
    if is_locked(RunFolder(path).lock):
        raise ValueError(f"{run} trains; stop it first")
    return path


def move(studio: Studio, source: Path, target: Path) -> None:
    """Moves a run, which then has no row where it was."""
    atomic.make_folder(target.parent)
    source.rename(target)
    studio.forget(source)
