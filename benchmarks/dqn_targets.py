"""Trains DQN on CartPole-v1 with four environments and several kinds of target, in rejeu and in Stable-Baselines3.

    python benchmarks/dqn_targets.py device host                 # the loops of rejeu
    python benchmarks/dqn_targets.py sb3 [--seeds 0 1 2 3 4]     # with a Python that has Stable-Baselines3

One gradient step follows each step of the four environments. The mean return of 20 greedy episodes after 120,000 environment
steps is written to ``benchmarks/results/dqn_targets.json``; results of other loops there stay. Stable-Baselines3 has no
setting for the loss: its function is replaced.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import provenance, read, write

RESULT = Path(__file__).parent / "results" / "dqn_targets.json"
STEPS = 120_000
COMMON: dict[str, Any] = {
    "learning_rate": 1e-3,
    "batch_size": 64,
    "buffer_size": 50_000,
    "learning_starts": 1_000,
    "exploration_fraction": 0.5,
    "policy_kwargs": {"net_arch": [64, 64]},
}
SQUARED = {"loss": "squared", "tau": 0.01, "target_update_interval": 4}
CASES: dict[str, dict[str, Any]] = {
    "tau 0.01, Huber": {"tau": 0.01, "target_update_interval": 1},
    "tau 0.039, Huber": {"tau": 1 - 0.99**4, "target_update_interval": 4},
    "tau 0.01, squared, clipped": {**SQUARED, "max_grad_norm": 10.0},
    "tau 0.01, squared": {**SQUARED, "max_grad_norm": None},
    "copied every 400 steps, Huber": {"tau": 1.0, "target_update_interval": 400},
}


def of_rejeu(case: str, seed: int, on_device: bool) -> float:
    """Returns the return after training in rejeu, in the environment in JAX."""
    import rejeu

    env = rejeu.make_vector("jax/CartPole-v1", n_envs=4)
    agent = rejeu.DQN("MlpPolicy", env, seed=seed, train_freq=4, **COMMON, **CASES[case])
    agent.on_device = on_device
    return agent.learn(STEPS).evaluate(20, seed=99).mean_return


def of_sb3(case: str, seed: int) -> float:
    """Returns the return after training in Stable-Baselines3, in Gymnasium's environment."""
    import torch
    from stable_baselines3 import DQN
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.dqn import dqn

    torch.set_num_threads(1)
    settings = dict(CASES[case])
    huber, squared = torch.nn.functional.smooth_l1_loss, torch.nn.functional.mse_loss
    dqn.F.smooth_l1_loss = squared if settings.pop("loss", "") == "squared" else huber
    if settings.get("max_grad_norm", 10.0) is None:
        settings["max_grad_norm"] = 1e9
    env = make_vec_env("CartPole-v1", 4, seed=seed)
    agent = DQN("MlpPolicy", env, seed=seed, train_freq=1, device="cpu", **COMMON, **settings)
    agent.learn(STEPS)
    dqn.F.smooth_l1_loss = huber
    return float(evaluate_policy(agent, make_vec_env("CartPole-v1", 1, seed=99), 20)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("loops", nargs="+", choices=("device", "host", "sb3"))
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    arguments = parser.parse_args()
    for loop in arguments.loops:
        for case in arguments.cases:
            train = of_sb3 if loop == "sb3" else lambda case, seed, on=loop == "device": of_rejeu(case, seed, on)
            returns = [round(train(case, seed), 1) for seed in arguments.seeds]
            mean = round(sum(returns) / len(returns), 1)
            row = {"case": case, "loop": loop, "mean_return": mean, "returns": ", ".join(f"{r:.0f}" for r in returns)}
            print(row, flush=True)
            earlier_rows = read(RESULT).get("summary", [])
            rows = [earlier for earlier in earlier_rows if (earlier["case"], earlier["loop"]) != (case, loop)] + [row]
            rows.sort(key=lambda row: (list(CASES).index(row["case"]), row["loop"]))
            write(RESULT, {**provenance(), "common": COMMON, "cases": CASES, "summary": rows}, "summary")


if __name__ == "__main__":
    main()
