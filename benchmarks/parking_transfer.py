"""Trains SAC with HER in the JAX environment of parking, and evaluates the policies there and in highway-env itself.

    python benchmarks/parking_transfer.py
    python benchmarks/parking_transfer.py --seeds 1 --episodes 100 --out /tmp/transfer.json

``jax/Parking-v0`` is a reimplementation. Whether a policy that was trained in it succeeds as often in highway-env's
``parking-v0``, stepped by Gymnasium, is measured with the preset: the weights are those of the best evaluation during
training, as with ``rejeu train``, and the 500 episodes of each environment are new ones. The result has the success rates
with their 95 % intervals (Wilson), and the difference with the interval that follows from them (Newcombe 1998, method 10).
They agree if that interval contains 0. It is written to ``benchmarks/results/parking_transfer.json``.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import jax
from scipy import stats

import rejeu
from rejeu import presets
from rejeu.algorithms import config as configs
from rejeu.callbacks import Evaluate
from rejeu.runs.config import versions

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import machine, provenance, write

RESULT = Path(__file__).parent / "results" / "parking_transfer.json"
TRAINED = "jax/Parking-v0"
EVALUATED = {"device": (TRAINED, 50, "jax"), "highway_env": ("parking-v0", 8, "gymnasium-async")}
"""Environments of the evaluation: id, number and backend."""


def train(seed: int, n_steps: int | None) -> tuple[Any, float]:
    """Returns an agent with the best weights, and the seconds that making and training it took, compilation included."""
    preset, began = presets.find(TRAINED), time.perf_counter()
    assert preset is not None
    env = rejeu.make_vector(TRAINED, preset.n_envs, seed=seed)
    agent = rejeu.AGENTS[preset.algorithm]("MultiInputPolicy", env, seed=seed, **preset.hyperparameters)
    agent.on_device = True
    agent.learn(n_steps or preset.total_steps, Evaluate(TRAINED, preset.evaluate_every, preset.evaluate_episodes))
    agent.restore_best()
    return agent, time.perf_counter() - began


def evaluate(agent: Any, where: str, episodes: int, seed: int) -> dict[str, Any]:
    """Returns the statistics of new episodes in one of the environments."""
    env_id, n_envs, backend = EVALUATED[where]
    with closing(rejeu.make_vector(env_id, n_envs, backend, seed=seed)) as env:  # type: ignore[arg-type]
        found = agent.evaluate(episodes, env=env)
    return {**found.to_dict(), "n_successes": int(found.successes.sum())}


def wilson(n_successes: int, n: int) -> tuple[float, float]:
    """Returns the 95 % interval of a success rate."""
    bounds = stats.binomtest(n_successes, n).proportion_ci(method="wilson")
    return float(bounds.low), float(bounds.high)


def compared(evaluations: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Returns the difference of the success rates, highway-env minus device, with its 95 % interval."""
    ours, real = evaluations["device"], evaluations["highway_env"]
    (p, (p_low, p_high)), (q, (q_low, q_high)) = (
        (one["success_rate"], wilson(one["n_successes"], one["episodes"])) for one in (real, ours)
    )
    low, high = (p - q) - math.hypot(p - p_low, q_high - q), (p - q) + math.hypot(p_high - p, q - q_low)
    return {"difference": p - q, "interval": [low, high], "agree": low <= 0.0 <= high}


def pooled(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Returns the same of all seeds together."""
    found = {}
    for where in EVALUATED:
        n, n_successes = (sum(run[where][key] for run in runs) for key in ("episodes", "n_successes"))
        found[where] = {"episodes": n, "n_successes": n_successes, "success_rate": n_successes / n}
        found[where]["success_interval"] = wilson(n_successes, n)
    return {**found, **compared(found)}


def main() -> None:
    """Trains, evaluates, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[11, 12, 13])
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--steps", type=int, help="environment steps of the training; by default those of the preset")
    parser.add_argument("--out", type=Path, default=RESULT)
    arguments = parser.parse_args()
    runs = []
    for seed in arguments.seeds:
        agent, seconds = train(seed, arguments.steps)
        run: dict[str, Any] = {"seed": seed, "steps": agent.num_timesteps, "training_seconds": seconds}
        for where in EVALUATED:
            run[where] = evaluate(agent, where, arguments.episodes, 1_000_000 + seed)
        runs.append({**run, **compared(run)})
        print(json.dumps(runs[-1]), flush=True)
    preset = presets.find(TRAINED)
    assert preset is not None
    content = {
        **provenance(),
        "machine": machine(),
        "device": f"{jax.devices()[0].device_kind} ({jax.default_backend()})",
        "versions": versions(),
        "hyperparameters": configs.to_json(agent.config),
        "n_envs": preset.n_envs,
        "runs": runs,
        "all": pooled(runs),
    }
    write(arguments.out, content)
    print(json.dumps(content["all"]))


if __name__ == "__main__":
    main()
