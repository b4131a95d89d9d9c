"""Commands that the studio starts. They are processes of their own, which go on when the studio ends."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Sequence
from pathlib import Path

from rejeu.core import atomic
from rejeu.lab.runs.process import end_of, start_apart
from rejeu.lab.runs.read import is_file

HIDDEN = ".studio"
"""Folder of the logs, beside the run folders."""
STARTED: dict[tuple[str, str], subprocess.Popen[bytes]] = {}
"""The processes by command and run: what is under way is not started twice. That a run begins is one command."""


def start(words: Sequence[str], run: Path) -> subprocess.Popen[bytes]:
    """Starts the command ``rejeu`` with these words, detached from this process; what it prints is added to the log of a run.

    Raises:
        OSError: if that is impossible.
        ValueError: if the same command is under way.
    """
    key = words[0].replace("branch", "train"), os.path.normcase(run)
    if (running := STARTED.get(key)) is not None and running.poll() is None:
        raise ValueError(f"rejeu {words[0]} is under way for {run.name}; wait until it has ended")
    log = log_of(run)
    atomic.check_no_link(log.parent)
    atomic.make_folder(log.parent)
    process = STARTED[key] = start_apart(words, log)
    return process


def log_of(run: Path) -> Path:
    """Returns where the log of a run is that the studio started."""
    return run.parent / HIDDEN / f"{run.name}.log"


def read_log(run: Path) -> str:
    """Returns the end of what a run has printed, of one that a sweep or the studio started; else nothing."""
    for path in (log_of(run), run.parent / f"{run.name}.log"):
        if is_file(path):
            return plain(end_of(path))
    return ""


def last_line(run: Path) -> str:
    """Returns the last line that a run has printed; see :func:`read_log`."""
    return read_log(run).strip().rpartition("\n")[2]


def plain(text: str) -> str:
    r"""Returns text of a terminal without colors, and of lines that were written over the last state.

    >>> plain("\x1b[1m10 %\r20 %\nend\n")
    '20 %\nend\n'
    """
    lines = re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", text).replace("\r\n", "\n").split("\n")
    return "\n".join(line.rstrip("\r").rpartition("\r")[2] for line in lines)
