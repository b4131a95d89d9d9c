"""Origin of results: commit, date, command and machine."""

from __future__ import annotations

import platform
import shlex
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]


def provenance(names: dict[str, str] | None = None) -> dict[str, str]:
    """Returns the origin of the results that this command is about to record.

    Args:
        names: replacements of arguments, such as paths of this machine, in the recorded command.
    """
    arguments = [(names or {}).get(argument, argument) for argument in sys.argv[1:]]
    script = Path(sys.argv[0]).resolve().relative_to(ROOT).as_posix()
    return {
        "commit": commit(),
        "date": time.strftime("%Y-%m-%d"),
        "command": shlex.join(["python", script, *arguments]),
        "python": platform.python_version(),
        "system": platform.system(),
    }


def commit() -> str:
    """Returns the commit of the working tree, and whether its sources differ from the commit."""
    head = git("rev-parse", "--short", "HEAD")
    return f"{head}, with changes" if git("status", "--porcelain", "--", "src", "tests", "trials/*.py") else head


def git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
