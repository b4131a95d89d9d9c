"""Trains by one script with rejeu or with Stable-Baselines3, and records the returns of the trained policies.

    python benchmarks/sb3_scripts.py rejeu
    python benchmarks/sb3_scripts.py original        # in an environment that has stable-baselines3

The settings are those that RL Baselines3 Zoo has for these tasks, where it has some, shortened to the steps below. They were
not tuned for either library. A policy is evaluated in 100 new episodes. Each library has its own file in
``benchmarks/results/sb3_scripts``; ``--only`` and ``--seeds`` replace the rows of these algorithms and seeds in it.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import provenance, read, write

RESULTS = Path(__file__).parent / "results" / "sb3_scripts"
LIBRARIES = {"rejeu": ("rejeu.sb3", "rejeu"), "original": ("stable_baselines3", "stable-baselines3")}
"""Module and distribution of each library."""
TASKS: dict[str, tuple[str, int, int, dict[str, Any]]] = {
    "PPO": (
        "CartPole-v1",
        8,
        50_000,
        {"n_steps": 32, "batch_size": 256, "gae_lambda": 0.8, "gamma": 0.98, "n_epochs": 20, "learning_rate": 1e-3},
    ),
    "A2C": ("CartPole-v1", 8, 100_000, {}),
    "DQN": (
        "CartPole-v1",
        1,
        50_000,
        {
            "learning_rate": 2.3e-3,
            "batch_size": 64,
            "buffer_size": 100_000,
            "learning_starts": 1000,
            "target_update_interval": 10,
            "train_freq": 256,
            "gradient_steps": 128,
            "exploration_fraction": 0.16,
            "exploration_final_eps": 0.04,
            "policy_kwargs": {"net_arch": [256, 256]},
        },
    ),
    "SAC": ("Pendulum-v1", 1, 10_000, {"learning_rate": 1e-3}),
    "TD3": (
        "Pendulum-v1",
        1,
        10_000,
        {"gamma": 0.98, "buffer_size": 200_000, "learning_starts": 1000, "learning_rate": 1e-3, "noise": 0.1},
    ),
}
"""Environment, number of environments, steps and hyperparameters; ``noise`` is the standard deviation of action noise."""
EPISODES = 100


def train(module: str, name: str, seed: int) -> dict[str, Any]:
    """Returns the mean return of a trained policy, and the seconds of its training."""
    library = importlib.import_module(module)
    make_vec_env = importlib.import_module(f"{module}.common.env_util").make_vec_env
    evaluate_policy = importlib.import_module(f"{module}.common.evaluation").evaluate_policy
    noise = importlib.import_module(f"{module}.common.noise").NormalActionNoise
    env_id, n_envs, steps, settings = TASKS[name]
    settings = dict(settings)
    if sigma := settings.pop("noise", 0.0):
        settings["action_noise"] = noise(np.zeros(1), sigma * np.ones(1))
    began = time.perf_counter()
    model = getattr(library, name)("MlpPolicy", make_vec_env(env_id, n_envs=n_envs, seed=seed), seed=seed, **settings)
    model.learn(steps)
    seconds = time.perf_counter() - began
    test_env = make_vec_env(env_id, n_envs=10, seed=1_000_000 + 100 * seed)
    mean, std = evaluate_policy(model, test_env, n_eval_episodes=EPISODES, deterministic=True)
    return {
        "algorithm": name,
        "env_id": env_id,
        "steps": steps,
        "seed": seed,
        "mean_return": round(float(mean), 2),
        "std_return": round(float(std), 2),
        "seconds": round(seconds, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("library", choices=LIBRARIES)
    parser.add_argument("--only", nargs="+", choices=TASKS, default=[*TASKS])
    parser.add_argument("--seeds", nargs="+", type=int, default=[*range(5)])
    arguments = parser.parse_args()
    module, distribution = LIBRARIES[arguments.library]
    path = RESULTS / f"{arguments.library}.json"
    for name in arguments.only:
        for seed in arguments.seeds:
            row = train(module, name, seed)
            print(row, flush=True)
            rows = read(path).get("runs", [])
            rows = [earlier for earlier in rows if (earlier["algorithm"], earlier["seed"]) != (name, seed)] + [row]
            origin = {**provenance(), "version": metadata.version(distribution), "episodes": EPISODES}
            write(path, {**origin, "runs": rows}, rows="runs")


if __name__ == "__main__":
    main()
