"""How much memory the machine has."""

from __future__ import annotations

import os
import re
from pathlib import Path

MEMINFO = Path("/proc/meminfo")


def physical_memory() -> int | None:
    """Returns the bytes of physical memory; None where the system does not say, as on Windows."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None


def free_memory() -> int | None:
    """Returns the bytes of physical memory that programs can still get; all of it where the system does not say.

    None where the system says neither, as on Windows.
    """
    try:
        found = re.search(r"^MemAvailable:\s+(\d+) kB$", MEMINFO.read_text(encoding="ascii"), re.MULTILINE)
    except (OSError, ValueError):
        found = None
    return 1024 * int(found[1]) if found else physical_memory()
