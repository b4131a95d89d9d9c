"""What the measurements share: their command line, their clock and how an agent of each library is made."""

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
    """Calls ``measure`` with the JSON object on the command line and prints what it returns as the last line."""
    result = measure(**json.loads(sys.argv[1]))
    print(json.dumps(result), flush=True)


def timed(function: Callable[..., Any]) -> Any:
    """Returns ``function`` with an attribute ``seconds``: the wall time spent in it so far."""

    def call(*args: Any, **kwargs: Any) -> Any:
        began = time.perf_counter()
        try:
            return function(*args, **kwargs)
        finally:
            call.seconds += time.perf_counter() - began  # type: ignore[attr-defined]

    call.seconds = 0.0  # type: ignore[attr-defined]
    return call


def seconds_of(act: Callable[[], Any], seconds: float, warm_up: int = 3, chunks: int = 7) -> float:
    """Returns the median over ``chunks`` stretches of the seconds that one ``act()`` takes, ``seconds`` in all."""
    for _ in range(warm_up):
        act()
    began = time.perf_counter()
    act()
    n = max(1, int(seconds / chunks / max(time.perf_counter() - began, 1e-9)))
    found = []
    for _ in range(chunks):
        began = time.perf_counter()
        for _ in range(n):
            act()
        found.append((time.perf_counter() - began) / n)
    return median(found)


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
    """Returns how many threads torch has, and whether rejeu takes one (1) or all (0) for an agent's updates."""
    used: dict[str, Any] = {"torch_threads": threads_of(library)}
    if library == "rejeu":
        used["threads"] = 1 if agent.n_threads(n_envs) == 1 else 0
    return used


def threads_of(library: str) -> int | None:
    """Returns how many threads torch works with, None where the library has no torch in its updates."""
    if library != "sb3":
        return None
    import torch

    return torch.get_num_threads()


def wait(agent: Any, library: str) -> None:
    """Waits until what was queued on the device is done."""
    if library == "rejeu":
        import jax

        jax.block_until_ready(agent.run.state)
    elif library == "sbx":
        import jax

        jax.block_until_ready(
            agent.policy.actor_state if hasattr(agent.policy, "actor_state") else agent.policy.qf_state
        )


def time_learning(agent: Any, library: str, warm_up: int, unit: int, seconds: float) -> dict[str, Any]:
    """Trains and returns the seconds of a step once everything is compiled, and what else there is to know.

    Args:
        agent: with a ``learn`` as Stable-Baselines3 has it.
        library: of the agent.
        warm_up: environment steps before the clock starts; everything is compiled in them.
        unit: steps are taken in multiples of it, a rollout on-policy.
        seconds: about how long the clock runs.
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
    taken = run(steps)
    result: dict[str, Any] = {"seconds_per_step": taken / steps, "steps": steps, "seconds": taken}
    if library == "rejeu":
        from rejeu import xla

        spent = {part: value - before[part] for part, value in agent.seconds.items()}
        parts = {part: spent[part] / steps for part in ("env", "replay", "update")}
        result["seconds_by_part"] = parts | {"rest": taken / steps - sum(parts.values())}
        result["compile_seconds"] = xla.seconds()
    return result


def resident_bytes() -> int | None:
    """Returns how much memory this process holds, None where that is not told; freed memory is given back before."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError, TypeError):  # where the C library is not glibc
        ctypes.CDLL(None).malloc_trim(0)
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
