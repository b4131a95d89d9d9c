"""Compares PPO on LunarLanderContinuous-v3 with the algorithm of a course, with the same budget.

    python benchmarks/lunar_lander_document.py --seeds 0 1 2 3 4

The course trains a simple form of PPO for 10 iterations, each with one complete episode of each of 20 actors. It has a
fixed standard deviation, advantages that are returns-to-go minus value, two optimizers and 5 epochs. ``plain`` runs
this algorithm with rejeu's PPO for exactly these 200 episodes. ``tuned`` takes as many environment steps as the runs of
the course (23,000), with hyperparameters chosen on seeds 100 to 103. Timing covers everything from the construction of
the environments to the last update, including compilation. Each run has its own process. The results are written to
``benchmarks/results/lunar_lander_document.json``. They contain the mean return and the success rate (return of 200 or
more) of the last 20 training episodes, which the course reports, and of 100 episodes of the deterministic policy after
training.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import in_process, machine, provenance, write

RESULT = Path(__file__).parent / "results" / "lunar_lander_document.json"
ENV = "LunarLanderContinuous-v3"
LAST = 20
"""Episodes per iteration of the course."""
PLAIN: dict[str, Any] = {
    "n_episodes": 1,
    "n_epochs": 5,
    "batch_size": 64,
    "gamma": 0.99,
    "gae_lambda": 1.0,
    "learning_rate": 3e-4,
    "critic_learning_rate": 3e-4,
    "max_grad_norm": None,
    "vf_coef": 1.0,
    "policy_kwargs": {
        "activation_fn": "relu",
        "ortho_init": False,
        "learn_std": False,
        "log_std_init": 0.5 * float(np.log(0.5)),
    },
}
TUNED: dict[str, Any] = {
    "normalize": True,
    "n_steps": 64,
    "n_epochs": 20,
    "batch_size": 64,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "learning_rate": "lin_2e-3",
}
VARIANTS: dict[str, tuple[int, dict[str, Any], dict[str, Any]]] = {
    "plain": (20, PLAIN, {"episodes": 200}),
    "tuned": (16, TUNED, {"total_timesteps": 23_000}),
}
"""Environments, hyperparameters, and the duration of ``learn``."""


def child(variant: str, seed: int) -> None:
    """Trains once and prints the result as JSON."""
    import rejeu

    n_envs, settings, budget = VARIANTS[variant]
    began = time.perf_counter()
    env = rejeu.make_vector(ENV, n_envs, "envpool", seed=seed)
    agent = rejeu.PPO("MlpPolicy", env, seed=seed, **settings).learn(**budget)
    seconds = time.perf_counter() - began
    last = [episode["r"] for episode in agent.ep_info_buffer][-LAST:]
    evaluation = agent.evaluate(100, env=rejeu.make_vector(ENV, 10, "envpool", seed=1_000_000 + 100 * seed))
    print(
        json.dumps(
            {
                "seed": seed,
                "steps": agent.num_timesteps,
                "seconds": round(seconds, 2),
                "last_training_return": float(np.mean(last)),
                "last_training_success": float(np.mean(np.array(last) >= 200)),
                "mean_return": evaluation.mean_return,
                "success_rate": evaluation.success_rate,
            }
        )
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--child", nargs=2, metavar=("VARIANT", "SEED"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        child(arguments.child[0], int(arguments.child[1]))
        return
    runs: dict[str, list[dict]] = {variant: [] for variant in VARIANTS}
    for seed in arguments.seeds:
        for variant in VARIANTS:
            runs[variant].append(in_process(sys.executable, __file__, "--child", variant, str(seed)))
            if "error" in runs[variant][-1]:
                raise SystemExit(runs[variant][-1]["error"])
            print(variant, json.dumps(runs[variant][-1]), flush=True)
    keys = ("steps", "seconds", "last_training_return", "last_training_success", "mean_return", "success_rate")
    result = {
        **provenance(),
        "machine": machine(),
        "hyperparameters": {variant: settings for variant, (_, settings, _) in VARIANTS.items()},
        "runs": runs,
        "means": {v: {key: float(np.mean([run[key] for run in by])) for key in keys} for v, by in runs.items()},
    }
    write(RESULT, result)
    print(json.dumps(result["means"], indent=1))


if __name__ == "__main__":
    main()
