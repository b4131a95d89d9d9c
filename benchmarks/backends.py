"""Measures environment steps per second of each backend, for the environments with presets and for LunarLander.

    python benchmarks/backends.py

Actions are random and resets are included. The result is the median of several rounds. Worker processes are measured
for environments whose step takes a millisecond or more in this process. The results are written to
``benchmarks/results/backends.json`` and printed as the table of ``docs/environments.md``.
"""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import closing
from pathlib import Path
from statistics import median

from gymnasium.vector.utils import batch_space

import rejeu
from rejeu.envs.envpool import envpool_knows
from rejeu.envs.make import auto_backend
from rejeu.runs.config import versions

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import machine, provenance, write

RESULT = Path(__file__).parent / "results" / "backends.json"
CASES = {
    "CartPole-v1": (1, 4, 16),
    "Pendulum-v1": (1, 4, 16),
    "MountainCar-v0": (1, 16),
    "LunarLander-v3": (1, 16),
    "LunarLanderContinuous-v3": (1, 16),
    "FetchReach-v4": (1, 4),
    "parking-v0": (1, 16),
    "rejeu/Ball-v0": (8,),
}
"""Numbers of environments that are measured."""
BACKENDS = ("envpool", "gymnasium", "gymnasium-async")
SLOW_STEP = 1e-3
"""Minimum duration of a step in this process, in seconds, for worker processes to be measured."""
ROUND_SECONDS = 0.1
"""Duration of one measurement, in seconds."""


def measure(env_id: str, n_envs: int, rounds: int) -> dict[str, float]:
    def several(backends: tuple[str, ...]) -> dict[str, float]:
        found = [{backend: rate(env_id, n_envs, backend) for backend in backends} for _ in range(rounds)]
        return {backend: median(one[backend] for one in found) for backend in backends}

    rates = several(("envpool", "gymnasium") if envpool_knows(env_id) else ("gymnasium",))
    if n_envs > 1 and rates["gymnasium"] * SLOW_STEP < 1.0:
        rates |= several(("gymnasium-async",))
    return rates


def rate(env_id: str, n_envs: int, backend: str) -> float:
    """Returns the environment steps per second of a backend."""
    with closing(rejeu.make_vector(env_id, n_envs, backend, seed=0)) as vector:
        space = batch_space(vector.action_space, n_envs)
        space.seed(0)
        actions = [space.sample() for _ in range(32)]
        vector.reset()
        n_steps, began = 0, time.perf_counter()
        while n_steps < 10 or time.perf_counter() - began < ROUND_SECONDS:
            step = vector.step(actions[n_steps % len(actions)])
            n_steps += 1
            if (done := step.terminated | step.truncated).any():
                vector.reset_done(done)
        return n_steps * n_envs / (time.perf_counter() - began)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=7)
    rounds = parser.parse_args().rounds
    rows = [
        {"env": env_id, "n_envs": n, "steps_per_second": {k: round(v) for k, v in measure(env_id, n, rounds).items()}}
        for env_id, numbers in CASES.items()
        for n in numbers
    ]
    write(RESULT, {**provenance(), "machine": machine(), "versions": versions(), "results": rows})
    print("| environment | at once | EnvPool | this process | workers | `auto` takes |\n|---|---|---|---|---|---|")
    for row in rows:
        rates = row["steps_per_second"]
        cells = [f"{rates[backend]:,}" if backend in rates else "" for backend in BACKENDS]
        print(f"| `{row['env']}` | {row['n_envs']} | {' | '.join(cells)} | {auto_backend(row['env'], row['n_envs'])} |")


if __name__ == "__main__":
    main()
