"""Learns from demonstrations: offline, by imitation, and by a share in every batch; records returns and steps.

    python benchmarks/demonstrations.py offline --env Pendulum-v1 --seeds 0 1 2
    python benchmarks/demonstrations.py imitation --seeds 0 1 2
    python benchmarks/demonstrations.py share --env jax/PointMaze-v0 --seeds 0 1 2 3 4 5 6 7 8 9

``offline``: two datasets of 20,000 steps, of the final policy of a SAC expert and of its policy after a part of its training
with random actions in a tenth of the steps; BC, TD3+BC, IQL and ReBRAC learn from each alone. ``imitation``: BC from 10
episodes of Gymnasium's scripted expert on LunarLander-v3, and DAgger with it, for the same number of gradient steps in each
round. ``share``: SAC with HER alone, with 20 episodes of an expert in half of each batch, and so after cloning them; the steps
after which 90 % of 20 evaluation episodes succeeded, all that were taken if they never did. Each result is written when it is
there, with command, commit and versions.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import rejeu
from rejeu.callbacks import Evaluate
from rejeu.demonstrations import Demonstrations, clone, dagger, learn_offline, record

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.learning import summary
from trials.provenance import machine, provenance, write as save

RESULTS = Path(__file__).parent / "results" / "demonstrations"
EXPERTS = {"Pendulum-v1": (8_000, 3_000), "LunarLanderContinuous-v3": (60_000, 20_000)}
"""Steps of SAC for the expert and for the medium policy."""
WEIGHTS: dict[str, dict[str, Any]] = {
    "medium": {"TD3BC": {"alpha": 5.0}, "ReBRAC": {"actor_bc": 0.01, "critic_bc": 0.1}},
    "expert": {"TD3BC": {"alpha": 1.0}, "ReBRAC": {"actor_bc": 1.0, "critic_bc": 0.01}},
}
"""How much recorded actions weigh, for each dataset the best of those tried on seed 100."""
N_STEPS, EPISODES = 20_000, 50


class Noisy:
    """Plays the actions of an agent, and random ones in a share of the steps."""

    def __init__(self, agent: Any, share: float) -> None:
        self.agent, self.share, self.rng = agent, share, np.random.default_rng(0)

    def predict(self, obs: Any, deterministic: bool = True) -> tuple[Any, None]:
        action, _ = self.agent.predict(obs, deterministic=True)
        if self.rng.random() < self.share:
            space = self.agent.action_space
            action = self.rng.uniform(space.low, space.high).astype(space.dtype)
        return action, None


class Scripted:
    """The controller that Gymnasium ships with LunarLander."""

    def __init__(self, env: gym.Env) -> None:
        from gymnasium.envs.box2d.lunar_lander import heuristic

        self.env, self.heuristic = env, heuristic

    def predict(self, obs: Any, deterministic: bool = True) -> tuple[Any, None]:
        return self.heuristic(self.env, obs), None


def dataset(player: Any, env_id: str) -> Demonstrations:
    """Returns whole episodes of at least ``N_STEPS`` steps."""
    shown = record(player, env_id, 1, seed=0)
    while shown.n_steps < N_STEPS:
        shown = shown + record(player, env_id, 1, seed=len(shown.episodes))
    return shown


def offline(arguments: argparse.Namespace) -> None:
    """Compares the offline algorithms on a dataset of an expert and of a medium policy."""
    env_id, results = arguments.env, []
    last, middle = EXPERTS[env_id]
    agent = rejeu.SAC("MlpPolicy", env_id, seed=1000).learn(middle)
    shown = {"medium": dataset(Noisy(agent, 0.1), env_id)}
    agent.learn(last - middle, reset_num_timesteps=False)
    shown["expert"] = dataset(agent, env_id)
    small: dict[str, Any] = {"policy_kwargs": {"net_arch": [128, 128]}}
    for name, data in shown.items():
        for algorithm in ("BC", "TD3BC", "IQL", "ReBRAC"):
            for seed in arguments.seeds:
                began = time.perf_counter()
                kind = rejeu.TD3 if algorithm == "BC" else getattr(rejeu, algorithm)
                more = {"batch_size": 256} if algorithm == "ReBRAC" else {}
                more |= WEIGHTS[name].get(algorithm, {})
                learner = kind("MlpPolicy", env_id, seed=seed, **small, **more)
                if algorithm == "BC":
                    clone(learner, data, arguments.updates, batch_size=256, seed=seed)
                else:
                    learn_offline(learner, data, arguments.updates)
                found = learner.evaluate(EPISODES, seed=10_000 + seed)
                one = {"data": name, "algorithm": algorithm, "seed": seed, "mean_return": found.mean_return}
                results.append({**one, "data_return": data.mean_return, "seconds": time.perf_counter() - began})
                write(arguments, results)


def imitation(arguments: argparse.Namespace) -> None:
    """Compares BC and DAgger from 10 episodes of an expert."""
    env_id, results = "LunarLander-v3", []
    env = gym.make(env_id)
    expert = Scripted(env)
    shown = record(expert, env, 10, seed=0)
    settings: dict[str, Any] = {"policy_kwargs": {"net_arch": [128, 128]}}
    for seed in arguments.seeds:
        agent = rejeu.PPO("MlpPolicy", env_id, seed=seed, **settings)
        rounds: list[dict[str, Any]] = []

        def say(i: int, known: Demonstrations, agent: Any = agent, rounds: Any = rounds, seed: int = seed) -> None:
            found = agent.evaluate(EPISODES, seed=10_000 + seed)
            rounds.append({"round": i, "labeled_steps": known.n_steps, "mean_return": found.mean_return})

        dagger(
            agent,
            lambda obs: expert.predict(obs)[0],
            env,
            shown,
            rounds=5,
            steps=1000,
            updates=arguments.updates,
            seed=seed,
            after_round=say,
        )
        results.append({"seed": seed, "expert_return": shown.mean_return, "rounds": rounds})
        write(arguments, results)


def share(arguments: argparse.Namespace) -> None:
    """Compares learning without demonstrations, with a share of them, and with a share after cloning."""
    env_id, results = arguments.env, []
    settings: dict[str, Any] = {
        "replay_buffer_class": "HerReplayBuffer",
        "policy_kwargs": {"net_arch": [64, 64], "layer_norm": True},
        "batch_size": 128,
        "learning_rate": 1e-3,
        "gamma": arguments.gamma,
        "learning_starts": 500,
        "buffer_size": 100_000,
    }
    expert = rejeu.SAC("MultiInputPolicy", env_id, seed=1000, **settings)
    expert.learn(arguments.expert_steps, Evaluate(env_id, 2_000, 50))
    expert.restore_best()
    folder = Path(tempfile.mkdtemp()) / "shown"
    shown = record(expert, env_id, 20, folder, seed=0)
    for seed in arguments.seeds:
        for way in ("none", "share", "clone and share"):
            more = {} if way == "none" else {"demonstrations": folder}
            agent = rejeu.SAC("MultiInputPolicy", env_id, seed=seed, **settings, **more)
            agent.on_device = False
            if way == "clone and share":
                clone(agent, shown, arguments.updates, batch_size=128, seed=seed)
            evaluate = Evaluate(env_id, arguments.every, 20, seed=10_000 + seed)

            def goes_on(agent: Any, turn: Any, evaluate: Evaluate = evaluate) -> bool:
                return not evaluate.results or evaluate.results[-1].evaluation.success_rate < 0.9

            began = time.perf_counter()
            agent.learn(arguments.steps, [evaluate, goes_on])
            rates = [(one.step, one.evaluation.success_rate) for one in evaluate.results]
            steps = next((step for step, rate in rates if rate >= 0.9), None)
            one = {"seed": seed, "demonstrations": way, "steps_to_90": steps, "rates": rates}
            results.append({**one, "shown_return": shown.mean_return, "seconds": time.perf_counter() - began})
            write(arguments, results)


def write(arguments: argparse.Namespace, results: list[dict[str, Any]]) -> None:
    """Writes the results so far with their summary over the seeds, and prints the newest."""
    print(json.dumps(results[-1]), flush=True)
    out = arguments.out or RESULTS / f"{arguments.what}-{arguments.env.replace('/', '-')}.json"
    save(out, {**provenance(), "machine": machine(), "summary": summarized(results), "results": results}, "results")


def summarized(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns the mean over the seeds and its interval, for each algorithm and dataset, round, or with and without a share."""
    rows = [{**one, **part} for one in results for part in one.get("rounds", [{}])]
    kinds = [name for name in ("data", "algorithm", "round", "demonstrations") if name in rows[0]]
    measure = "steps_to_90" if "steps_to_90" in rows[0] else "mean_return"
    groups: dict[tuple[Any, ...], list[float]] = {}
    for row in rows:
        value = row["rates"][-1][0] if row[measure] is None else row[measure]
        groups.setdefault(tuple(row[name] for name in kinds), []).append(value)
    return [{**dict(zip(kinds, key, strict=True)), **(summary(values) or {})} for key, values in groups.items()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("offline", "imitation", "share"))
    parser.add_argument("--env", default="LunarLander-v3")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--updates", type=int, default=10_000)
    parser.add_argument("--steps", type=int, default=40_000)
    parser.add_argument("--every", type=int, default=500)
    parser.add_argument("--gamma", type=float, default=0.98)
    parser.add_argument("--expert-steps", type=int, default=30_000)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    {"offline": offline, "imitation": imitation, "share": share}[arguments.what](arguments)


if __name__ == "__main__":
    main()
