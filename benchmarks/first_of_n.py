"""Compares SAC on Pendulum-v1 with the first results that arrive against lockstep, where steps take random times.

    python benchmarks/first_of_n.py
    python benchmarks/first_of_n.py --seeds 2 --steps 3000

Eight worker processes sleep in every step, for exponentially distributed times that no seed determines. Both kinds of run
take the same number of environment steps and gradient steps, with the hyperparameters of the preset. The returns of the
deterministic policy at the end and the times are written to ``benchmarks/results/first_of_n.json`` and printed, with means
over the seeds and their 95 % bootstrap intervals.
"""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import closing
from functools import partial
from pathlib import Path
from random import SystemRandom
from typing import Any

import gymnasium as gym
import numpy as np

import rejeu
from rejeu import presets
from rejeu.reporting import statistics
from rejeu.runs.config import versions

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import machine, provenance, write

RESULT = Path(__file__).parent / "results" / "first_of_n.json"
ENV = "Pendulum-v1"
WAYS = {"lockstep": None, "first_4_of_8": 4}
N_SAMPLES = 10_000
"""Bootstrap samples of an interval."""


class Uneven(gym.Wrapper[Any, Any, Any, Any]):
    """Steps take random times with the given mean, in seconds."""

    def __init__(self, env: gym.Env, mean_seconds: float) -> None:
        super().__init__(env)
        self.mean_seconds = mean_seconds

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        time.sleep(SystemRandom().expovariate(1 / self.mean_seconds))
        return self.env.step(action)


def make(mean_seconds: float) -> gym.Env:
    return Uneven(gym.make(ENV), mean_seconds)


def train(seed: int, wait_for: int | None, n_steps: int, mean_seconds: float) -> dict[str, float]:
    """Returns the mean return at the end, and the seconds of training after the random steps at the start."""
    preset = presets.default(ENV, "SAC")
    one = partial(make, mean_seconds)
    with closing(rejeu.make_vector(one, 8, "gymnasium-async", seed=seed, wait_for=wait_for)) as env:
        agent = rejeu.SAC("MlpPolicy", env, seed=seed, **preset.hyperparameters)
        agent.learn(n_steps)
        return {
            "mean_return": float(np.mean(agent.evaluate(100, ENV, seed=1000 + seed).returns)),
            "seconds": agent.seconds["total"],
            "steps": agent.num_timesteps,
            "updates": agent.n_updates,
        }


def with_interval(values: list[float]) -> dict[str, float]:
    """Returns the mean of values and its 95 % bootstrap interval."""
    scores, rng = [np.array(values)], np.random.default_rng(0)
    low, high = statistics.interval(
        statistics.mean(statistics.resampled(scores, statistics.draw(scores, N_SAMPLES, rng)))
    )
    return {"mean": float(np.mean(values)), "low": float(low), "high": float(high)}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--mean-seconds", type=float, default=0.005, help="mean time that a step sleeps")
    parser.add_argument("--out", type=Path, default=RESULT)
    arguments = parser.parse_args()
    runs: dict[str, list[dict[str, float]]] = {name: [] for name in WAYS}
    for seed in range(arguments.seeds):
        for name, wait_for in WAYS.items():
            runs[name].append(train(seed, wait_for, arguments.steps, arguments.mean_seconds))
            found = runs[name][-1]
            print(f"seed {seed}  {name:<13} return {found['mean_return']:8.1f}  {found['seconds']:6.1f} s", flush=True)
    summary = {
        name: {key: with_interval([run[key] for run in found]) for key in ("mean_return", "seconds")}
        for name, found in runs.items()
    }
    pairs = zip(runs["first_4_of_8"], runs["lockstep"], strict=True)
    summary["difference"] = {
        "mean_return": with_interval([one["mean_return"] - other["mean_return"] for one, other in pairs])
    }
    for name, parts in summary.items():
        texts = [f"{key} {one['mean']:.1f} [{one['low']:.1f}, {one['high']:.1f}]" for key, one in parts.items()]
        print(f"{name}: {', '.join(texts)}")
    content = {
        **provenance(),
        "machine": machine(),
        "versions": versions(),
        "steps": arguments.steps,
        "mean_step_seconds": arguments.mean_seconds,
        "summary": summary,
        "runs": runs,
    }
    write(arguments.out, content)


if __name__ == "__main__":
    main()
