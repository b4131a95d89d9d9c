"""Measures time and file size of saving and loading a model, and a replay buffer with a given number of transitions."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import gymnasium as gym

from benchmarks.bench.work import buffers, common

REPEATS = 5


class Goals(gym.Env):
    """An environment with the spaces of parking. Agents need one, but it is never stepped."""

    observation_space = buffers.observation_space("parking")
    action_space = buffers.action_space("parking")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), 0.0, False, False, {}


def measure(library: str, n: int) -> dict[str, Any]:
    """Saves and loads a SAC agent with the default networks, and a full buffer of ``n`` transitions of parking."""
    settings = {"buffer_size": n, "seed": 0}
    agent_class = common.algorithm_of(library, "SAC")
    if library == "sb3":
        settings["device"] = "cpu"
    agent = agent_class("MultiInputPolicy", Goals(), **settings)
    agent.learn(110)  # some updates, because Adam's moments may not exist before the first
    if library == "sb3":
        buffers.fill_sb3(agent.replay_buffer)
    else:
        agent.replay_buffer.ring = buffers.rejeu_ring("parking", n)
    with tempfile.TemporaryDirectory() as folder:
        model, buffer = Path(folder) / "model", Path(folder) / "buffer"
        result = {
            "save model": repeat(lambda: agent.save(model)),
            "load model": repeat(lambda: agent_class.load(model)),
            "save buffer": repeat(lambda: agent.save_replay_buffer(buffer)),
            "load buffer": repeat(lambda: agent.load_replay_buffer(buffer)),
        }
        sizes = {name: next(Path(folder).glob(f"{name}*")).stat().st_size for name in ("model", "buffer")}
    return {"seconds": result, "bytes": sizes}


def repeat(act: Callable[[], Any]) -> float:
    """Returns the median duration of ``act()`` in seconds, without the first call."""
    found = []
    for _ in range(REPEATS + 1):
        began = time.perf_counter()
        act()
        found.append(time.perf_counter() - began)
    return median(found[1:])


if __name__ == "__main__":
    common.main(measure)
