"""Trains Stable-Baselines3 with the settings of ``zoo.toml``, where rejeu differs from what RL Zoo published.

    python benchmarks/zoo_original.py LunarLander-v3 A2C --seeds 0 1 2
    python benchmarks/zoo_original.py parking-v0 SAC --goals --seeds 0

It runs in an environment with Stable-Baselines3 and without rejeu, and plays 100 episodes with the last weights, as
``learning.py --zoo`` does. The seeds are added to those in ``benchmarks/results/zoo_original.json``. ``--goals`` takes the
settings of rejeu's preset but for ``layer_norm`` and ``n_steps``, which Stable-Baselines3 does not have with hindsight, and
for ``learning_starts`` where no episode has ended by then; Gymnasium-Robotics 1.4 needs ``mujoco<3.12`` there. It records
success rates and seconds in ``benchmarks/results/goals_original.json``.
"""

from __future__ import annotations

import argparse
import json
import time
import tomllib
from pathlib import Path
from typing import Any

import gymnasium as gym
import stable_baselines3
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

HERE = Path(__file__).parent
ZOO, RESULTS = HERE / "zoo.toml", HERE / "results" / "zoo_original.json"
GOALS, GOAL_RESULTS = (
    HERE.parent / "src" / "rejeu" / "agents" / "presets" / "presets.toml",
    HERE / "results" / "goals_original.json",
)
MARKS = (50_000, 100_000, 300_000)
"""Steps after which the success of an agent is measured, besides the end."""


def train(preset: dict[str, Any], seed: int) -> Any:
    """Returns the mean return of 100 episodes after training; of goals, success rates by steps and the seconds."""
    settings = dict(preset["hyperparameters"])
    is_normalized = settings.pop("normalize", False)
    if isinstance(rate := settings.get("learning_rate"), str):
        start = float(rate.removeprefix("lin_"))
        settings["learning_rate"] = lambda progress_remaining: progress_remaining * start
    if "activation_fn" in (policy := dict(settings.get("policy_kwargs", {}))):
        policy["activation_fn"] = {"relu": torch.nn.ReLU, "tanh": torch.nn.Tanh}[policy["activation_fn"]]
    env, test = (make_vec_env(preset["env_id"], n, seed=s) for n, s in ((preset["n_envs"], seed), (10, 10_000 + seed)))
    if is_normalized:
        env = VecNormalize(env, gamma=settings.get("gamma", 0.99))
        test = VecNormalize(test, training=False, norm_reward=False)
        test.obs_rms = env.obs_rms
    algorithm = getattr(stable_baselines3, preset["algorithm"])
    if has_goals := "replay_buffer_class" in settings:
        policy.pop("layer_norm", None)
        settings.pop("n_steps", None)
        length = env.get_attr("spec")[0].max_episode_steps or 0  # it samples from finished episodes only
        settings["learning_starts"] = max(settings["learning_starts"], (length + 1) * preset["n_envs"])
        settings |= {"replay_buffer_class": stable_baselines3.HerReplayBuffer, "gradient_steps": -1}
    policy_name = "MultiInputPolicy" if has_goals else "MlpPolicy"
    model = algorithm(policy_name, env, seed=seed, device="cpu", **{**settings, "policy_kwargs": policy})
    if not has_goals:
        model.learn(preset["total_steps"])
        return float(evaluate_policy(model, test, 100)[0])
    watch = Success(test)
    model.learn(preset["total_steps"], callback=watch)
    watch.measure()
    return {"success_curve": watch.curve, "seconds": round(watch.training, 1)}


class Success(BaseCallback):
    """Measures the success rate of 100 episodes at each of :data:`MARKS`, and the seconds of training alone."""

    def __init__(self, test: VecEnv) -> None:
        super().__init__()
        self.test, self.curve, self.training, self.since = test, [], 0.0, time.perf_counter()

    def _on_step(self) -> bool:
        before = self.num_timesteps - self.training_env.num_envs
        if any(before < mark <= self.num_timesteps for mark in MARKS):
            self.measure()
        return True

    def measure(self) -> None:
        self.training += time.perf_counter() - self.since
        succeeded: list[bool] = []

        def after(local: dict[str, Any], _: Any) -> None:
            if local["done"]:  # as rejeu counts: whether the goal is reached at the end
                info = local["info"]
                succeeded.append(bool(info.get("is_success", info.get("success"))))

        evaluate_policy(self.model, self.test, 100, callback=after)
        self.curve.append([self.num_timesteps, sum(succeeded) / len(succeeded)])
        print(self.curve[-1], f"{self.training:.0f} s", flush=True)
        self.since = time.perf_counter()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env_id")
    parser.add_argument("algorithm")
    parser.add_argument("--goals", action="store_true", help="with the settings of rejeu's preset")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    source, results = (GOALS, GOAL_RESULTS) if arguments.goals else (ZOO, RESULTS)
    if arguments.goals:
        import gymnasium_robotics
        import highway_env

        gym.register_envs(gymnasium_robotics)
        gym.register_envs(highway_env)
    presets = tomllib.loads(source.read_text(encoding="utf-8"))["preset"]
    ours = (arguments.env_id, arguments.algorithm)
    preset = next(candidate for candidate in presets if (candidate["env_id"], candidate["algorithm"]) == ours)
    for seed in arguments.seeds:
        recorded = json.loads(results.read_text(encoding="utf-8")) if results.exists() else {}
        recorded["version"] = stable_baselines3.__version__
        recorded.setdefault("-".join(ours), {})[str(seed)] = train(preset, seed)
        results.write_text(json.dumps(recorded, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
