"""Trains Stable-Baselines3 with the settings of ``zoo.toml``, where rejeu differs from what RL Zoo published.

    python benchmarks/zoo_original.py LunarLander-v3 A2C --seeds 0 1 2

It runs in an environment with Stable-Baselines3 and without rejeu, and plays 100 episodes with the last weights, as
``learning.py --zoo`` does. The seeds are added to those in ``benchmarks/results/zoo_original.json``.
"""

from __future__ import annotations

import argparse
import json
import tomllib
from pathlib import Path
from typing import Any

import stable_baselines3
import torch
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "zoo_original.json"


def train(preset: dict[str, Any], seed: int) -> float:
    """Returns the mean return of 100 episodes after training."""
    settings = dict(preset["hyperparameters"])
    is_normalized = settings.pop("normalize", False)
    if isinstance(rate := settings.get("learning_rate"), str):
        start = float(rate.removeprefix("lin_"))
        settings["learning_rate"] = lambda left: left * start
    if "activation_fn" in (policy := dict(settings.get("policy_kwargs", {}))):
        policy["activation_fn"] = {"relu": torch.nn.ReLU, "tanh": torch.nn.Tanh}[policy["activation_fn"]]
    env, test = (make_vec_env(preset["env_id"], n, seed=s) for n, s in ((preset["n_envs"], seed), (10, 10_000 + seed)))
    if is_normalized:
        env = VecNormalize(env, gamma=settings.get("gamma", 0.99))
        test = VecNormalize(test, training=False, norm_reward=False)
        test.obs_rms = env.obs_rms
    algorithm = getattr(stable_baselines3, preset["algorithm"])
    model = algorithm("MlpPolicy", env, seed=seed, device="cpu", **{**settings, "policy_kwargs": policy})
    model.learn(preset["total_steps"])
    return float(evaluate_policy(model, test, 100)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env_id")
    parser.add_argument("algorithm")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    known = tomllib.loads((HERE / "zoo.toml").read_text(encoding="utf-8"))["preset"]
    ours = (arguments.env_id, arguments.algorithm)
    preset = next(one for one in known if (one["env_id"], one["algorithm"]) == ours)
    for seed in arguments.seeds:
        found = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
        found["version"] = stable_baselines3.__version__
        found.setdefault("-".join(ours), {})[str(seed)] = train(preset, seed)
        RESULTS.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
