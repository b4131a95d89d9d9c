"""Measures environment steps per second of environments in workers, as a share of the ideal number.

    python benchmarks/remote.py
    python benchmarks/remote.py --backends ray --workers 8 --step 0.1 --seconds 5

Each environment sleeps in every step, so that the ideal is ``workers / step time`` on any number of cores. Measured are
local worker processes and actors of a Ray cluster on this machine; all environments together (lockstep), and the first
``k`` results that arrive, an eighth of all. The results are written to ``benchmarks/results/remote.json`` and printed.
"""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import rejeu
from rejeu import cluster
from rejeu.runs.config import versions

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import machine, provenance, write

ROOT = Path(__file__).parents[1]
RESULT = Path(__file__).parent / "results" / "remote.json"
STEP_SECONDS = (0.01, 0.1)
WORKERS = (1, 2, 4, 8, 16, 32, 64)
BACKENDS = ("gymnasium-async", "ray")
OBSERVATION = 32
"""Numbers in an observation."""


class Sleeper(gym.Env):
    """Sleeps in every step; episodes do not end."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (OBSERVATION,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (4,), np.float32)

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(OBSERVATION, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        time.sleep(self.seconds)
        return np.zeros(OBSERVATION, np.float32), 0.0, False, False, {}


def alone(seconds: float, n_steps: int = 50) -> float:
    """Returns the mean time of one step in this process, in seconds: of the sleep, and what the system adds to it."""
    env = Sleeper(seconds)
    began = time.perf_counter()
    for _ in range(n_steps):
        env.step(np.zeros(4, np.float32))
    return (time.perf_counter() - began) / n_steps


def measure(backend: str, n_workers: int, step_seconds: float, wait_for: int | None, seconds: float) -> dict[str, Any]:
    """Returns the steps per second of environments, and this process's share of one core."""
    options: dict[str, Any] = {"ray": {"num_cpus": 0.01}} if backend == "ray" else {}
    make = partial(Sleeper, step_seconds)
    with closing(rejeu.make_vector(make, n_workers, backend, wait_for=wait_for, **options)) as env:  # type: ignore[arg-type]
        env.reset(seed=0)
        action = np.zeros((n_workers, 4), np.float32)
        take = partial(env.step, action) if wait_for is None else partial(send_and_receive, env, action)
        taken = n_workers if wait_for is None else wait_for
        for _ in range(3):
            take()
        n_steps, cpu, began = 0, time.process_time(), time.perf_counter()
        while time.perf_counter() - began < seconds:
            take()
            n_steps += taken
        spent = time.perf_counter() - began
        return {"steps_per_second": n_steps / spent, "learner_cpu": (time.process_time() - cpu) / spent}


def measure_both(backend: str, n_workers: int, step_seconds: float, seconds: float) -> dict[str, Any]:
    """Returns the results of both ways to step, with their shares of the ideal."""
    ideal, k = n_workers / step_seconds, max(n_workers // 8, 1)
    row: dict[str, Any] = {
        "step_seconds": step_seconds,
        "backend": backend,
        "workers": n_workers,
        "ideal": ideal,
        "k": k,
    }
    for name, wait_for in {"lockstep": None, "first_k": k}.items():
        found = measure(backend, n_workers, step_seconds, wait_for, seconds)
        row[name] = {**found, "share": found["steps_per_second"] / ideal}
    return row


def send_and_receive(env: Any, action: np.ndarray) -> None:
    """Gives new actions and takes the first results."""
    env.send(action)
    env.receive()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--backends", nargs="+", default=BACKENDS, choices=BACKENDS)
    parser.add_argument("--workers", nargs="+", type=int, default=WORKERS)
    parser.add_argument("--step", nargs="+", type=float, default=STEP_SECONDS, help="seconds that a step sleeps")
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of one measurement")
    parser.add_argument("--out", type=Path, default=RESULT)
    arguments = parser.parse_args()
    connection = cluster.connect() if "ray" in arguments.backends else None
    print("| step | backend | workers | lockstep | first k | k | share of ideal | learner's share of a core |")
    print("|---|---|---|---|---|---|---|---|")
    rows = []
    for step_seconds in arguments.step:
        own = alone(step_seconds)
        for backend in arguments.backends:
            for n_workers in arguments.workers:
                row = measure_both(backend, n_workers, step_seconds, arguments.seconds)
                rows.append({**row, "alone_seconds": own})
                modes = [row["lockstep"], row["first_k"]]
                rates = " | ".join(f"{mode['steps_per_second']:,.0f}" for mode in modes)
                shares = " / ".join(f"{mode['share']:.1%}" for mode in modes)
                cpu = " / ".join(f"{mode['learner_cpu']:.0%}" for mode in modes)
                print(
                    f"| {step_seconds} | {backend} | {n_workers} | {rates} | {row['k']} | {shares} | {cpu} |",
                    flush=True,
                )
    if connection is not None:
        connection.close()
    content = {**provenance(), "machine": machine(), "versions": versions(), "seconds": arguments.seconds}
    write(arguments.out, {**content, "results": rows})


if __name__ == "__main__":
    main()
