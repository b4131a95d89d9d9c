"""Measures sampling of batches of 256 from full replay buffers: hindsight, and prioritized replay with its update."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.bench.work import buffers, common

BATCH = 256


def measure(library: str, what: str, sizes: list[int], seconds: float) -> dict[str, Any]:
    """Returns the seconds per batch by buffer size. ``what`` is ``"hindsight"`` or ``"priority"``."""
    make = sb3_sampler if library == "sb3" else rejeu_sampler
    return {"seconds_per_batch": {str(size): common.seconds_of(make(what, size), seconds, 20) for size in sizes}}


def rejeu_sampler(what: str, size: int) -> Any:
    from rejeu.buffers.hindsight import HerReplayBuffer, HindsightConfig
    from rejeu.buffers.prioritized import Priorities, PriorityConfig
    from rejeu.buffers.uniform import ReplayBuffer
    from rejeu.envs.make import make_vector

    rng = np.random.default_rng(0)
    if what == "hindsight":
        goals = make_vector("parking-v0", 1, "gymnasium").goals()
        replay: Any = HerReplayBuffer(buffers.rejeu_ring("parking", size), 0.99, HindsightConfig(), goals)
        return lambda: replay.sample(rng, (BATCH,))
    ring = buffers.rejeu_ring("pendulum", size)
    priorities = Priorities(ring, PriorityConfig())
    priorities.restore()
    replay = ReplayBuffer(ring, 0.99, priorities=priorities)
    td_errors = [rng.exponential(size=BATCH).astype(np.float32) for _ in range(64)]
    turn = 0

    def draw_and_update() -> None:
        nonlocal turn
        _, drawn = replay.draw(rng, (BATCH,), 0.5)
        assert drawn is not None
        replay.update_priorities([(drawn, td_errors[turn % len(td_errors)])])
        turn += 1

    return draw_and_update


def sb3_sampler(what: str, size: int) -> Any:
    import gymnasium as gym
    import highway_env
    from stable_baselines3 import HerReplayBuffer
    from stable_baselines3.common.vec_env import DummyVecEnv

    assert what == "hindsight"
    gym.register_envs(highway_env)
    env = DummyVecEnv([lambda: gym.make("parking-v0")])
    buffer = HerReplayBuffer(
        size, buffers.observation_space("parking"), buffers.action_space("parking"), env, device="cpu", n_sampled_goal=4
    )
    buffers.fill_sb3(buffer)
    return lambda: buffer.sample(BATCH)


if __name__ == "__main__":
    common.main(measure)
