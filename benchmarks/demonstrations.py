"""Learns from demonstrations: offline, by imitation, and by a share in every batch; records returns and steps.

    python benchmarks/demonstrations.py offline --env Pendulum-v1 --seeds 0 1 2
    python benchmarks/demonstrations.py imitation --seeds 0 1 2
    python benchmarks/demonstrations.py share --env jax/PointMaze-v0 --seeds 0 1 2 3 4 5 6 7 8 9
    python benchmarks/demonstrations.py record --env FetchPickAndPlace-v4 --shown FOLDER

``offline``: two datasets of 20,000 steps, of the final policy of a SAC expert and of its policy after a part of its training
with random actions in a tenth of the steps; BC, TD3+BC, IQL and ReBRAC learn from each alone. ``imitation``: BC from 10
episodes of Gymnasium's scripted expert on LunarLander-v3, and DAgger with it, for the same number of gradient steps in each
round. ``share``: SAC with HER alone, with 20 episodes of an expert in half of each batch, after cloning them, and after the
critics have also learned the value of the clone from them. The expert is scripted for FetchPush and FetchPickAndPlace, and
elsewhere SAC with the same settings; ``--shown FOLDER`` keeps its episodes for the next call, and ``record`` only writes them.
All train for as many steps: recorded are the first step (0: before training) at which 90 % of 20 evaluation episodes
succeeded, all steps if they never did, and the mean success rate of all evaluations. ``--continue`` keeps the runs of the
result file. Each result is written when it is there, with command, commit and versions.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import rejeu
from rejeu.agents import presets
from rejeu.callbacks import Evaluate
from rejeu.demonstrations import Demonstrations, clone, dagger, learn_offline, read, record

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.learning import summary
from trials.provenance import machine, provenance, read as read_results, write as save

RESULTS = Path(__file__).parent / "results" / "demonstrations"
EXPERTS = {"Pendulum-v1": (8_000, 3_000), "LunarLanderContinuous-v3": (60_000, 20_000)}
"""Steps of SAC for the expert and for the medium policy."""
WEIGHTS: dict[str, dict[str, Any]] = {
    "medium": {"TD3BC": {"alpha": 5.0}, "ReBRAC": {"actor_bc": 0.01, "critic_bc": 0.1}},
    "expert": {"TD3BC": {"alpha": 1.0}, "ReBRAC": {"actor_bc": 1.0, "critic_bc": 0.01}},
}
"""Weights of the recorded actions, for each dataset the best of those tried on seed 100."""
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
                agent_class = rejeu.TD3 if algorithm == "BC" else getattr(rejeu, algorithm)
                more = {"batch_size": 256} if algorithm == "ReBRAC" else {}
                more |= WEIGHTS[name].get(algorithm, {})
                learner = agent_class("MlpPolicy", env_id, seed=seed, **small, **more)
                if algorithm == "BC":
                    clone(learner, data, arguments.updates, batch_size=256, seed=seed)
                else:
                    learn_offline(learner, data, arguments.updates)
                evaluation = learner.evaluate(EPISODES, seed=10_000 + seed)
                row = {"data": name, "algorithm": algorithm, "seed": seed, "mean_return": evaluation.mean_return}
                results.append({**row, "data_return": data.mean_return, "seconds": time.perf_counter() - began})
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

        def record_round(
            i: int, labeled: Demonstrations, agent: Any = agent, rounds: Any = rounds, seed: int = seed
        ) -> None:
            evaluation = agent.evaluate(EPISODES, seed=10_000 + seed)
            rounds.append({"round": i, "labeled_steps": labeled.n_steps, "mean_return": evaluation.mean_return})

        dagger(
            agent,
            lambda obs: expert.predict(obs)[0],
            env,
            shown,
            rounds=5,
            steps=1000,
            updates=arguments.updates,
            seed=seed,
            after_round=record_round,
        )
        results.append({"seed": seed, "expert_return": shown.mean_return, "rounds": rounds})
        write(arguments, results)


def hyperparameters(env_id: str) -> dict[str, Any]:
    """Returns the hyperparameters of the preset of SAC for an environment."""
    preset = presets.find(env_id, "SAC")
    assert preset is not None
    return preset.hyperparameters


SHARE: dict[str, tuple[int, str, dict[str, Any]]] = {
    "jax/PointMaze-v0": (
        1,
        "auto",
        {
            "replay_buffer_class": "HerReplayBuffer",
            "policy_kwargs": {"net_arch": [64, 64], "layer_norm": True},
            "batch_size": 128,
            "learning_rate": 1e-3,
            "gamma": 0.98,
            "learning_starts": 500,
            "buffer_size": 100_000,
        },
    ),
    "jax/Parking-v0": (16, "auto", hyperparameters("parking-v0")),
    "FetchPush-v4": (8, "envpool", {**hyperparameters("FetchPush-v4"), "priorities": None}),
    "FetchPickAndPlace-v4": (8, "envpool", {**hyperparameters("FetchPickAndPlace-v4"), "priorities": None}),
}
"""Number of environments, backend and hyperparameters of ``share``: those of presets without priorities, which cannot be
combined with demonstrations."""
WAYS = {"none": "", "share": "", "clone": "clone", "clone and critics": "clone critics"}
"""Steps before training, by the name of a way; all but the first have a share of demonstrations in each batch."""


class Pusher:
    """Goes behind the object, as seen from the goal, and pushes it there: a scripted expert of FetchPush."""

    def predict(self, obs: Any, deterministic: bool = True) -> tuple[Any, None]:
        gripper, block, goal = obs["observation"][:3], obs["achieved_goal"], obs["desired_goal"]
        distance = float(np.linalg.norm(goal[:2] - block[:2]))
        way = (goal[:2] - block[:2]) / max(distance, 1e-6)
        offset = gripper[:2] - block[:2]
        aside = offset - (offset @ way) * way
        is_low, is_near = gripper[2] < block[2] + 0.03, np.linalg.norm(offset) < 0.12
        target = np.array([*(block[:2] - 0.09 * way), block[2] + 0.1])
        if distance < 0.03:
            target = np.array([*gripper[:2], gripper[2] + 0.1])
        elif offset @ way < -0.02 and np.linalg.norm(aside) < (0.025 if is_low else 0.015):
            ahead = min(distance, 0.05) * way - 1.5 * aside if is_low else 0.0
            target = np.array([*(gripper[:2] + ahead), block[2]])
        elif gripper[2] < block[2] + 0.07 and is_near:
            target[:2] = gripper[:2]
        return np.array([*np.clip(10 * (target - gripper), -1, 1), 0], np.float32), None


class Picker:
    """Goes above the object, grasps it and carries it to the goal: a scripted expert of FetchPickAndPlace."""

    def predict(self, obs: Any, deterministic: bool = True) -> tuple[Any, None]:
        gripper, fingers = obs["observation"][:3], obs["observation"][9:11]
        block, goal = obs["achieved_goal"], obs["desired_goal"]
        offset = block - gripper
        is_above = np.linalg.norm(offset[:2]) < 0.01
        is_around = is_above and abs(offset[2]) < 0.01
        if is_around and fingers.sum() < 0.055:
            way = goal - block
        elif is_above:
            way = offset
        else:
            way = np.array([*offset[:2], np.clip(0, offset[2] + 0.06, offset[2] + 0.1)])
        return np.array([*np.clip(10 * way, -1, 1), -1 if is_around else 1], np.float32), None


SCRIPTED: dict[str, Any] = {"FetchPush-v4": Pusher, "FetchPickAndPlace-v4": Picker}


def shown_by_expert(arguments: argparse.Namespace, folder: Path) -> Demonstrations:
    """Returns 20 episodes of an expert, those in the folder if it holds some."""
    if folder.exists():
        return read(folder)
    if arguments.env in SCRIPTED:
        expert = SCRIPTED[arguments.env]()
    else:
        expert = learner(arguments, 1000).learn(arguments.expert_steps, Evaluate(arguments.env, 2_000, 50))
        expert.restore_best()
    return record(expert, arguments.env, 20, folder, seed=0)


def learner(arguments: argparse.Namespace, seed: int, **more: Any) -> rejeu.SAC:
    """Returns SAC with the settings of an environment."""
    n_envs, backend, settings = SHARE[arguments.env]
    env = rejeu.make_vector(arguments.env, n_envs, backend=backend, seed=seed)
    return rejeu.SAC("MultiInputPolicy", env, seed=seed, **settings, **more)


def share(arguments: argparse.Namespace) -> None:
    """Compares learning without demonstrations, with a share of them, and with a share after cloning them."""
    folder = arguments.shown or Path(tempfile.mkdtemp()) / "shown"
    shown = shown_by_expert(arguments, folder)
    results = earlier_results(arguments)
    for seed, way in itertools.product(arguments.seeds, arguments.ways):
        if any((row["seed"], row["demonstrations"]) == (seed, way) for row in results):
            continue
        began = time.perf_counter()
        agent = learner(arguments, seed, **({} if way == "none" else {"demonstrations": folder}))
        agent.on_device = False
        if "clone" in WAYS[way]:
            clone(agent, shown, arguments.updates, batch_size=128, seed=seed)
        if "critics" in WAYS[way]:
            learn_offline(agent, shown, arguments.updates, keep_policy=True)
        env = rejeu.make_vector(arguments.env, 20, backend=SHARE[arguments.env][1], seed=10_000 + seed)
        evaluate = Evaluate(env, arguments.every, 20, seed=10_000 + seed)
        rates = [(0, agent.evaluate(20, seed=10_000 + seed, env=env).success_rate)]
        agent.learn(arguments.steps, evaluate)
        if agent.interrupted:
            sys.exit("stopped; --continue repeats this run")
        rates += [(evaluated.step, evaluated.evaluation.success_rate) for evaluated in evaluate.results]
        row = {"seed": seed, "demonstrations": way, "shown_return": shown.mean_return, "rates": rates}
        row["steps_to_90"] = next((step for step, rate in rates if rate >= 0.9), arguments.steps)
        row["mean_success"] = float(np.mean([rate for step, rate in rates]))
        results.append({**row, "seconds": time.perf_counter() - began})
        write(arguments, results)


def result_file(arguments: argparse.Namespace) -> Path:
    """Returns the file of the results."""
    return arguments.out or RESULTS / f"{arguments.what}-{arguments.env.replace('/', '-')}.json"


def earlier_results(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Returns the results of the file with ``--continue``, else none."""
    return read_results(result_file(arguments)).get("results", []) if arguments.goes_on else []


def write(arguments: argparse.Namespace, results: list[dict[str, Any]]) -> None:
    """Writes the results so far with their summary over the seeds, and prints the newest."""
    print(json.dumps(results[-1]), flush=True)
    content = {
        **provenance({str(arguments.shown): "FOLDER", str(arguments.out): "FILE"}),
        "machine": machine(),
        "summary": summarized(results),
        "results": results,
    }
    save(result_file(arguments), content, "results")


def summarized(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns the mean over the seeds and its interval, for each algorithm and dataset, round, or way of demonstrations."""
    rows = [{**result, **measures_of_round} for result in results for measures_of_round in result.get("rounds", [{}])]
    group_keys = [name for name in ("data", "algorithm", "round", "demonstrations") if name in rows[0]]
    measures = [name for name in ("mean_return", "steps_to_90", "mean_success") if name in rows[0]]
    summaries = []
    for measure in measures:
        groups: dict[tuple[Any, ...], list[float]] = {}
        for row in rows:
            groups.setdefault(tuple(row[name] for name in group_keys), []).append(row[measure])
        for key, values in groups.items():
            statistics: dict[str, Any] = summary(values) or {}
            low, high = statistics["interval"] or (None, None)
            summaries.append(
                {"measure": measure, **dict(zip(group_keys, key, strict=True)), **statistics, "low": low, "high": high}
            )
    return summaries


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("offline", "imitation", "share", "record"))
    parser.add_argument("--env", default="LunarLander-v3")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--updates", type=int, default=10_000)
    parser.add_argument("--steps", type=int, default=40_000)
    parser.add_argument("--every", type=int, default=500)
    parser.add_argument("--expert-steps", type=int, default=30_000)
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--shown", type=Path, help="folder of the episodes of the expert of share")
    parser.add_argument("--continue", action="store_true", dest="goes_on", help="keep the runs of the file, of share")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    if arguments.what == "record":
        shown_by_expert(arguments, arguments.shown or Path("shown"))
    else:
        {"offline": offline, "imitation": imitation, "share": share}[arguments.what](arguments)


if __name__ == "__main__":
    main()
