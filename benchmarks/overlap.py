"""Measures how acting with the weights of the second-newest update affects learning.

    python benchmarks/overlap.py

With ``overlap=True``, the default, the environments step while the newest update is computed. With ``overlap=False``,
every action waits for it. Both train the preset of each environment on the same seeds. The final weights are evaluated
on 100 episodes. Means over seeds and 95 % confidence intervals (Student's t) are written to
``benchmarks/results/overlap.json``.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from scipy import stats

import rejeu
from rejeu import presets

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import provenance, write

RESULT = Path(__file__).parent / "results" / "overlap.json"
CASES = {"Pendulum-v1": "SAC", "CartPole-v1": "DQN"}


def train(env_id: str, algorithm: str, overlap: bool, seed: int) -> dict[str, float]:
    preset = presets.find(env_id, algorithm)
    env = rejeu.make_vector(env_id, preset.n_envs, "gymnasium", seed)
    agent = rejeu.AGENTS[algorithm]("MlpPolicy", env, seed=seed, **{**preset.hyperparameters, "overlap": overlap})
    agent.learn(preset.total_steps)
    evaluation = agent.evaluate(100, env=env_id, seed=1000 + seed)
    env.close()
    return {"seed": seed, "return": evaluation.mean_return}


def summary(rows: list[dict[str, float]]) -> dict[str, float | list[float]]:
    returns = [row["return"] for row in rows]
    half = stats.t.ppf(0.975, len(returns) - 1) * np.std(returns, ddof=1) / len(returns) ** 0.5
    mean = float(np.mean(returns))
    return {"mean_return": mean, "interval": [mean - half, mean + half]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(10)))
    parser.add_argument("--cases", nargs="+", default=list(CASES))
    arguments = parser.parse_args()
    content: dict[str, object] = dict(provenance())
    for env_id in arguments.cases:
        rows: dict[bool, list[dict[str, float]]] = {True: [], False: []}
        for seed in arguments.seeds:
            for overlap in rows:
                rows[overlap].append(train(env_id, CASES[env_id], overlap, seed))
                print(env_id, overlap, rows[overlap][-1], flush=True)
        content[f"{CASES[env_id]} on {env_id}"] = {
            f"overlap={overlap}": {**summary(found), "runs": found} for overlap, found in rows.items()
        }
    write(RESULT, content)
    print(json.dumps(content))


if __name__ == "__main__":
    main()
