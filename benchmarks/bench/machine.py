"""The machine: its description, its current load, and whether its speed is constant."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

PACKAGES = {
    "rejeu": ("rejeu", "jax", "jaxlib", "equinox", "optax", "gymnasium", "highway-env", "envpool", "box2d", "numpy"),
    "sb3": ("stable-baselines3", "sb3-contrib", "torch", "gymnasium", "highway-env", "box2d", "numpy"),
    "sbx": ("sbx-rl", "stable-baselines3", "jax", "jaxlib", "flax", "optax", "torch", "gymnasium", "box2d", "numpy"),
}
"""Packages whose versions are reported, by library."""
BUSY = 0.35
"""Number of cores that other programs may use before the machine counts as busy."""
CALIBRATION_SIZE, CALIBRATION_ROUNDS = 384, 40
VERSIONS = """
import json, platform, sys
from importlib import metadata
versions = {"python": platform.python_version()}
for name in sys.argv[1:]:
    try:
        versions[name] = metadata.version(name)
    except metadata.PackageNotFoundError:
        versions[name] = None
print(json.dumps(versions))
"""


def describe() -> dict[str, Any]:
    """Returns the processor, number of cores, memory and operating system."""
    return {
        "processor": processor(),
        "cores": cores(),
        "memory_gib": memory_gib(),
        "system": f"{platform.system()} {platform.release().split('-')[0]} {platform.machine()}",
    }


def processor() -> str:
    """Returns the name of the processor as reported by the system."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def cores() -> int:
    """Returns the number of processors available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory_gib() -> float | None:
    """Returns the memory in GiB, or None if the system does not report it."""
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (AttributeError, ValueError, OSError):
        return None


def versions(python: str, library: str) -> dict[str, str | None]:
    """Returns the versions of Python and of a library's packages; None for packages that are not installed."""
    command = [python, "-c", VERSIONS, *PACKAGES[library]]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{python} cannot be run: {done.stderr.strip()[-500:]}")
    return json.loads(done.stdout)


SETTLE = 0.3
"""Time that the threads of a matrix product keep spinning after it, in seconds."""


def others_busy(seconds: float = 0.25) -> float | None:
    """Returns the number of cores that other programs currently use, or None if the system does not report it.

    This process sleeps during the measurement, so all CPU time that is not idle belongs to other programs.
    """
    stat = Path("/proc/stat")
    if not stat.exists():
        return None

    def ticks() -> tuple[float, float]:
        numbers = [float(word) for word in stat.read_text(encoding="ascii").splitlines()[0].split()[1:9]]
        return sum(numbers), numbers[3] + numbers[4]

    time.sleep(SETTLE)
    (total, idle), _ = ticks(), time.sleep(seconds)
    total_after, idle_after = ticks()
    passed = total_after - total
    return round((os.cpu_count() or 1) * (1.0 - (idle_after - idle) / passed), 2) if passed > 0 else None


def calibrate() -> float:
    """Returns the median duration of a fixed matrix product in milliseconds, to detect changes of the speed.

    >>> 0.0 < calibrate() < 1000.0
    True
    """
    a = np.random.default_rng(0).standard_normal((CALIBRATION_SIZE, CALIBRATION_SIZE)).astype(np.float32)
    out, durations = np.empty_like(a), []
    for _ in range(CALIBRATION_ROUNDS):
        began = time.perf_counter()
        np.matmul(a, a, out=out)
        durations.append(time.perf_counter() - began)
    return 1000.0 * median(durations)


def load() -> float | None:
    """Returns the load average of the last minute, or None if the system has none."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None


def why_busy() -> str | None:
    """Returns the reason why timings are currently unreliable, or None if the machine is idle.

    The load average is ignored if the system reports its current usage. It includes programs that ended within the last
    minute, such as a run of this program that is being resumed.
    """
    busy, average = others_busy(2.0), load()
    if busy is not None:
        return (
            f"other programs use {busy:.2f} of {cores()} cores now (at most {BUSY} would do)" if busy > BUSY else None
        )
    if average is not None and average > BUSY:
        return f"the load average of the last minute is {average:.2f} (at most {BUSY} would do)"
    return None
