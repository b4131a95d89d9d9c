"""Functions shared by the measurements: command line, timing and construction of agents."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any


def main(measure: Callable[..., dict[str, Any]]) -> None:
    """Calls ``measure`` with the JSON object from the command line and prints the result as the last line."""
    result = measure(**json.loads(sys.argv[1]))
    print(json.dumps(result), flush=True)


def timed(function: Callable[..., Any]) -> Any:
    """Returns ``function`` with an attribute ``seconds``: the total wall time spent in it."""

    def call(*args: Any, **kwargs: Any) -> Any:
        began = time.perf_counter()
        try:
            return function(*args, **kwargs)
        finally:
            call.seconds += time.perf_counter() - began  # type: ignore[attr-defined]

    call.seconds = 0.0  # type: ignore[attr-defined]
    return call


def seconds_of(act: Callable[[], Any], seconds: float, warm_up: int = 3, chunks: int = 7) -> float:
    """Returns the median seconds per call of ``act()``, over ``chunks`` intervals that last ``seconds`` in total."""
    for _ in range(warm_up):
        act()
    began = time.perf_counter()
    act()
    n = max(1, int(seconds / chunks / max(time.perf_counter() - began, 1e-9)))
    durations = []
    for _ in range(chunks):
        began = time.perf_counter()
        for _ in range(n):
            act()
        durations.append((time.perf_counter() - began) / n)
    return median(durations)


def algorithm_of(library: str, name: str) -> Any:
    """Returns the class of an algorithm in a library: ``rejeu``, ``sb3`` (with sb3-contrib) or ``sbx``."""
    if library == "rejeu":
        import rejeu as module
    elif library == "sbx":
        import sbx as module
    elif name in ("TQC", "QRDQN", "CrossQ"):
        import sb3_contrib as module
    else:
        import stable_baselines3 as module
    return getattr(module, name)


def threads_used(agent: Any, library: str, n_envs: int) -> dict[str, Any]:
    """Returns the number of torch threads, and whether rejeu uses one thread (1) or all (0) for an agent's updates."""
    used: dict[str, Any] = {"torch_threads": threads_of(library)}
    if library == "rejeu":
        used["threads"] = 1 if agent.n_threads(n_envs) == 1 else 0
    return used


def threads_of(library: str) -> int | None:
    """Returns the number of torch threads, or None if the library does not use torch for its updates."""
    if library != "sb3":
        return None
    import torch

    return torch.get_num_threads()


def wait(agent: Any, library: str) -> None:
    """Blocks until all operations on the device are finished."""
    if library == "rejeu":
        import jax

        jax.block_until_ready(agent.run.state)
    elif library == "sbx":
        import jax

        jax.block_until_ready(
            agent.policy.actor_state if hasattr(agent.policy, "actor_state") else agent.policy.qf_state
        )


def time_learning(agent: Any, library: str, warm_up: int, unit: int, seconds: float) -> dict[str, Any]:
    """Trains an agent and returns the seconds per step after compilation, and other statistics.

    Args:
        agent: an agent with the ``learn`` method of Stable-Baselines3.
        library: library of the agent.
        warm_up: environment steps before timing starts. Everything is compiled during these steps.
        unit: the number of steps is a multiple of this; for on-policy algorithms it is the size of a rollout.
        seconds: approximate duration of the timing.
    """
    agent.learn(warm_up)
    wait(agent, library)

    def run(steps: int) -> float:
        began = time.perf_counter()
        agent.learn(steps, reset_num_timesteps=False)
        wait(agent, library)
        return time.perf_counter() - began

    steps = max(1, round(seconds / run(unit))) * unit
    before = dict(agent.seconds) if library == "rejeu" else {}
    elapsed = run(steps)
    result: dict[str, Any] = {"seconds_per_step": elapsed / steps, "steps": steps, "seconds": elapsed}
    if library == "rejeu":
        from rejeu.core import xla

        spent = {part_name: value - before[part_name] for part_name, value in agent.seconds.items()}
        parts = {part_name: spent[part_name] / steps for part_name in ("env", "replay", "update")}
        result["seconds_by_part"] = parts | {"rest": elapsed / steps - sum(parts.values())}
        result["compile_seconds"] = xla.seconds()
    return result


def resident_bytes() -> int | None:
    """Returns the memory of this process, or None if the system does not report it. Freed memory is released first."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError, TypeError):  # the C library may not be glibc
        ctypes.CDLL(None).malloc_trim(0)
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
