"""Shared by trials and benchmarks: the origin of results, their files and intervals, and measurements in other processes."""

from __future__ import annotations

import json
import math
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


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


def machine() -> dict[str, Any]:
    """Returns processor, cores that this process may use, and load average."""
    from rejeu.core.xla import cores

    return {"processor": platform.processor() or platform.machine(), "cores": cores(), "load": os.getloadavg()[0]}


def commit(root: Path = ROOT) -> str:
    """Returns the commit of a working tree, and whether its sources differ from the commit."""
    head = git(root, "rev-parse", "--short", "HEAD")
    changes = git(root, "status", "--porcelain", "--", "src", "tests", "trials/*.py", "benchmarks/*.py")
    return f"{head}, with changes" if changes else head


def git(root: Path, *arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=True).stdout.strip()


def read(path: Path) -> dict[str, Any]:
    """Returns the content of a file of results, which is empty if there is no file."""
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def write(path: Path, content: dict[str, Any], rows: str = "") -> None:
    """Writes results as JSON; ``rows`` names a list of which each element is on one line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({key: value for key, value in content.items() if key != rows}, indent=1)
    if rows:
        lines = ",\n  ".join(json.dumps(row) for row in content[rows])
        text = f'{text[:-2]},\n "{rows}": [\n  {lines}\n ]\n}}'
    path.write_text(text + "\n", encoding="utf-8")


def half_interval(values: Sequence[float]) -> float:
    """Returns half the width of the 95 % confidence interval of the mean (Student's t), NaN for fewer than two values."""
    import numpy as np
    from scipy import stats

    n = len(values)
    return float(stats.t.ppf(0.975, n - 1) * np.std(values, ddof=1) / math.sqrt(n)) if n > 1 else math.nan


def in_process(*command: str, environment: dict[str, str] | None = None) -> dict[str, Any]:
    """Runs a command in a process of its own and returns the last line that it printed, which is JSON.

    A command that fails has only the key ``error``, with the last line of its standard error.
    """
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        return {"error": (done.stderr.strip().splitlines() or ["no message"])[-1]}
    result: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return result
