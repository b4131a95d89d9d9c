"""Measures the memory of a full replay buffer: the size of its arrays and the growth of the process."""

from __future__ import annotations

from typing import Any

from benchmarks.bench.work import buffers, common


def measure(library: str, task: str, n: int, compact: bool = False) -> dict[str, Any]:
    """Fills a buffer with ``n`` transitions. ``compact`` is Stable-Baselines3's ``optimize_memory_usage``."""
    make = sb3_buffer if library == "sb3" else rejeu_buffer
    make(task, 1000, compact)
    before = common.resident_bytes()
    buffer = make(task, n, compact)
    after = common.resident_bytes()
    grown = None if before is None or after is None else after - before
    size = buffers.nbytes(buffer) if library == "sb3" else buffer.nbytes
    return {"nbytes": size, "resident": grown, "necessary": n * buffers.necessary_bytes(task), "n": n}


def rejeu_buffer(task: str, n: int, compact: bool) -> Any:
    return buffers.rejeu_ring(task, n)


def sb3_buffer(task: str, n: int, compact: bool) -> Any:
    from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer

    spaces = buffers.observation_space(task), buffers.action_space(task)
    if task == "parking":
        return buffers.fill_sb3(DictReplayBuffer(n, *spaces, device="cpu"))
    return buffers.fill_sb3(
        ReplayBuffer(n, *spaces, device="cpu", optimize_memory_usage=compact, handle_timeout_termination=not compact)
    )


if __name__ == "__main__":
    common.main(measure)
