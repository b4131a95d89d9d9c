"""The videos of a report: a few are embedded within a budget, the others are linked."""

from __future__ import annotations

import base64
import os
import re
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core.records import shown
from rejeu.lab.runs.read import RunSummary
from rejeu.logs.tables import read_bytes

BUDGET = 5 * 2**19
"""Bytes of videos in a page; in base64 they take a third more."""


class Video(NamedTuple):
    """A video as a page shows it."""

    title: str
    name: str
    source: str
    """A data URL, empty if it is not embedded."""
    link: str
    """A relative link, empty if there is none."""
    megabytes: float


def collect(run: RunSummary, folder: Path | None, budget: int) -> tuple[list[Video], list[str], int]:
    """Returns first, last and best video of a run, notes on damaged ones, and the bytes that were embedded.

    Args:
        run: the run.
        folder: where the page will be, for relative links; None for no links.
        budget: most bytes to embed.
    """
    best = RunFolder(run.path).video
    during = [path for path in run.videos if path != best]
    titles = {path: "Best model" for path in run.videos if path == best}  # first, as the budget may not be enough
    titles |= dict.fromkeys(during[-1:], "Last") | dict.fromkeys(during[:-1][:1], "First")
    videos, notes, spent = [], [], 0
    for path, title in titles.items():
        try:
            size = path.stat().st_size
            content = read_bytes(path, min(size, budget - spent + 1))
        except OSError as error:
            notes.append(f"{shown(path.name)} cannot be read: {shown(error.strerror or error)}")
            continue
        if content[4:8] != b"ftyp":
            notes.append(f"{shown(path.name)} is no mp4 video")
            continue
        source = ""
        if size <= budget - spent:
            source = "data:video/mp4;base64," + base64.b64encode(content).decode("ascii")
            spent += size
        step = re.fullmatch(r"step_(\d{1,15})\.mp4", path.name)
        label = f"{title} (step {int(step[1]):,})" if step else title
        videos.append(Video(label, shown(path.name), source, link_to(path, folder), size / 2**20))
    return videos[::-1], notes, spent


def link_to(path: Path, folder: Path | None) -> str:
    """Returns a relative link to a file, empty if there is none.

    >>> link_to(Path("/runs/a/javascript:x.mp4"), Path("/runs"))
    './a/javascript%3Ax.mp4'
    """
    if folder is None:
        return ""
    try:
        relative = Path(os.path.relpath(path, folder.resolve()))
    except ValueError:  # on another drive
        return ""
    return "./" + quote(relative.as_posix().encode("utf-8", "surrogateescape"))
