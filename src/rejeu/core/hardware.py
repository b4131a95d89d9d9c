"""The memory and the processor cores that this process may use, and the folder that SDL asks for.

On Linux both may be limited by control groups, as in containers and under schedulers of clusters. A group cannot use more
than the groups that contain it, so the smallest limit counts.
"""

from __future__ import annotations

import math
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

CORES = "REJEU_CORES"
"""Environment variable with the most cores that a process should use; set for each run of a sweep."""
MEMINFO = Path("/proc/meminfo")
MEMBERSHIP = Path("/proc/self/cgroup")
"""Lines ``number:controllers:path``; in version 2 the number is 0 and there are no controllers."""
CGROUPS = Path("/sys/fs/cgroup")


def cores() -> int:
    """Returns the number of processor cores that this process may use; the environment variable ``REJEU_CORES`` limits it.

    A share of 1.5 cores, as containers may have, counts as 2.
    """
    try:
        n = len(os.sched_getaffinity(0))
    except AttributeError:  # macOS and Windows
        n = os.cpu_count() or 1
    for group in groups("cpu"):
        quota_file, period_file = group / "cpu.cfs_quota_us", group / "cpu.cfs_period_us"  # version 1
        quota, period = _text(group / "cpu.max").split() or (_text(quota_file).strip(), _text(period_file).strip())
        if quota.isdecimal() and period.isdecimal():
            n = min(n, max(math.ceil(int(quota) / int(period)), 1))
    limit = os.environ.get(CORES, "")
    return min(n, int(limit)) if limit.isdecimal() and int(limit) > 0 else n


def physical_memory() -> int | None:
    """Returns the bytes of memory that this process may use, of the machine or of its control group.

    None where the system does not say, as on Windows.
    """
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None
    return min([total, *(limit for _, limit in limited_groups())])


def free_memory() -> int | None:
    """Returns the bytes of memory that this process can still get; all of it where the system does not say.

    None where the system says neither, as on Windows. Files that a control group has in the cache count as free.
    """
    available = _value(MEMINFO, "MemAvailable:")
    free = physical_memory() if available is None else 1024 * available
    for group, limit in limited_groups():
        used = _value(group / "memory.current") or _value(group / "memory.usage_in_bytes") or 0
        cached = _value(group / "memory.stat", "total_inactive_file") or _value(group / "memory.stat", "inactive_file")
        remaining = max(limit - max(used - (cached or 0), 0), 0)
        free = remaining if free is None else min(free, remaining)
    return free


def limited_groups() -> Iterator[tuple[Path, int]]:
    """Yields each control group that limits the memory of this process, and its limit in bytes."""
    for group in groups("memory"):
        limit = _value(group / "memory.max") or _value(group / "memory.limit_in_bytes")
        if limit is not None and limit < 2**62:  # version 1 writes a larger number for no limit
            yield group, limit


def groups(controller: str) -> Iterator[Path]:
    """Yields the folder of this process's control group and those around it, for ``"memory"`` or ``"cpu"``."""
    for line in _text(MEMBERSHIP).splitlines():
        number, controllers, path = line.split(":", 2)
        if controller in controllers.split(","):
            root = CGROUPS / controller
        elif number == "0" and not controllers:
            root = CGROUPS
        else:
            continue
        group = root / path.strip("/")
        yield from (folder for folder in (group, *group.parents) if folder.is_relative_to(root) and folder.is_dir())


def _text(path: Path) -> str:
    """Returns the text of a file; nothing if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""


def _value(path: Path, name: str = "") -> int | None:
    """Returns the number after ``name`` at the beginning of a line; None if there is none, or no such file."""
    match = re.search(rf"^{name}\s*(\d+)", _text(path), re.MULTILINE)
    return int(match[1]) if match else None


def quiet_sdl() -> None:
    """Sets ``XDG_RUNTIME_DIR`` on Linux if it is missing, about which SDL would print a line for each screen."""
    if sys.platform.startswith("linux"):
        os.environ.setdefault("XDG_RUNTIME_DIR", tempfile.gettempdir())
