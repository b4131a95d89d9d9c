"""Trains a preset on several seeds and records the results, which the documentation reports.

    python benchmarks/learning.py Pendulum-v1 SAC --seeds 0 1 2 3 4

Training is the same as with ``rejeu train``, but without periodic evaluations. The final weights are evaluated on 100
new episodes. With ``--best``, the agent is also evaluated during training, as often as the preset specifies. The best
weights of these evaluations are then evaluated on new episodes. The results are written to
``benchmarks/results/learning/ENV-ALGO.json``, with the command, the versions and the hyperparameters. ``--shown`` leaves of
the observations only some components, which makes Pendulum partially observable, and ``--set`` changes hyperparameters of the
preset::

    python benchmarks/learning.py Pendulum-v1 SAC --shown 0 1 --set '{"policy_kwargs": {"lstm_hidden_size": 64}}' --name NAME
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import math
import platform
import shlex
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import TransformObservation
from scipy import stats

import rejeu
from rejeu import presets, validation
from rejeu.algorithms import config as configs
from rejeu.callbacks import Evaluate
from rejeu.envs import make_vector
from rejeu.envs.make import VectorEnv

RESULTS = Path(__file__).parent / "results" / "learning"


def train_one(preset: presets.Preset, seed: int, arguments: argparse.Namespace) -> dict:
    backend = arguments.backend or preset.backend
    began = time.perf_counter()

    def environments(n: int, seed: int) -> VectorEnv:
        if arguments.shown is None:
            return make_vector(preset.env_id, n, backend, seed, **arguments.env)
        return make_vector(lambda: partly_shown(preset.env_id, arguments.shown), n, "gymnasium", seed)

    env = environments(preset.n_envs, seed)
    nested = "Dict" in type(env.observation_space).__name__
    agent = rejeu.AGENTS[preset.algorithm](
        "MultiInputPolicy" if nested else "MlpPolicy", env, seed=seed, **settings_of(preset, arguments)
    )
    callback = None
    if arguments.best:
        test_env = environments(10, 2_000_000 + 100 * seed)
        callback = Evaluate(test_env, preset.evaluate_every, preset.evaluate_episodes)
    if arguments.minutes:
        agent.learn(minutes=arguments.minutes - (time.perf_counter() - began) / 60, callback=callback)
    else:
        agent.learn(arguments.steps or preset.total_steps, callback=callback)
    seconds = time.perf_counter() - began
    done = (
        seconds / (60 * arguments.minutes)
        if arguments.minutes
        else agent.num_timesteps / (arguments.steps or preset.total_steps)
    )
    if done < 0.99:
        raise SystemExit(
            f"seed {seed} was cut short after {seconds:.0f} s and {agent.num_timesteps:,} steps; nothing is recorded"
        )
    if arguments.best:
        agent.restore_best()
    evaluation_env = environments(10, 1_000_000 + 100 * seed)
    evaluation = agent.evaluate(arguments.episodes, env=evaluation_env)
    return {
        "seed": seed,
        "steps": agent.num_timesteps,
        "n_updates": agent.n_updates,
        "seconds": round(seconds, 1),
        "mean_return": evaluation.mean_return,
        "std_return": evaluation.std_return,
        "mean_length": evaluation.mean_length,
        "success_rate": None if math.isnan(evaluation.success_rate) else evaluation.success_rate,
        "episodes": arguments.episodes,
    }


def partly_shown(env_id: str, shown: list[int]) -> gym.Env:
    """Returns an environment of whose observations only some components are shown."""
    env = gym.make(env_id)
    space = env.observation_space
    return TransformObservation(env, lambda obs: obs[shown], gym.spaces.Box(space.low[shown], space.high[shown]))


def settings_of(preset: presets.Preset, arguments: argparse.Namespace) -> dict[str, Any]:
    """Returns the hyperparameters of a preset with others set; of those that are dicts, only the given parts change."""
    before = preset.hyperparameters
    return {**before, **{k: {**before.get(k, {}), **v} if isinstance(v, dict) else v for k, v in arguments.set.items()}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env_id")
    parser.add_argument("algorithm")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--steps", type=int)
    parser.add_argument("--minutes", type=float, help="train so long instead, everything from making the agent counted")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--backend")
    parser.add_argument("--env", type=json.loads, default={}, help="arguments of the environment, as JSON")
    parser.add_argument("--set", type=json.loads, default={}, help="hyperparameters other than the preset's, as JSON")
    parser.add_argument("--best", action="store_true", help="evaluate the best weights by evaluations on the way")
    parser.add_argument(
        "--shown", type=int, nargs="+", help="components of the observation that are shown; default: all"
    )
    parser.add_argument("--name", help="of the result file")
    arguments = parser.parse_args()
    preset = presets.find(arguments.env_id, arguments.algorithm)
    if preset is None:
        parser.error(f"there is no preset of {arguments.algorithm} for {arguments.env_id}")
    runs = []
    for seed in arguments.seeds:
        runs.append(train_one(preset, seed, arguments))
        print(json.dumps(runs[-1]), flush=True)
    result = {
        "command": shlex.join(["python", "benchmarks/learning.py", *sys.argv[1:]]),
        "machine": {"processor": platform.processor() or platform.machine(), "python": platform.python_version()},
        "versions": {
            "rejeu": rejeu.__version__,
            **{name: importlib.metadata.version(name) for name in ("jax", "gymnasium", "envpool")},
        },
        "hyperparameters": configs.to_json(
            validation.build(rejeu.AGENTS[preset.algorithm].algorithm.Config, settings_of(preset, arguments))
        ),
        "n_envs": preset.n_envs,
        "runs": runs,
        "summary": {key: summary([run[key] for run in runs]) for key in ("mean_return", "success_rate", "seconds")},
    }
    RESULTS.mkdir(parents=True, exist_ok=True)
    name = arguments.name or f"{arguments.env_id.replace('/', '-')}-{arguments.algorithm}"
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(result["summary"]), "->", path.relative_to(Path(__file__).parent.parent))


def summary(values: list) -> dict | None:
    """Returns the mean, minimum and maximum over seeds, and the 95 % confidence interval of the mean (Student's t)."""
    if any(value is None for value in values):
        return None
    mean, n = float(np.mean(values)), len(values)
    half = float(stats.t.ppf(0.975, n - 1) * np.std(values, ddof=1) / math.sqrt(n)) if n > 1 else math.nan
    interval = [mean - half, mean + half] if n > 1 else None
    return {"mean": mean, "interval": interval, "least": min(values), "largest": max(values), "seeds": n}


if __name__ == "__main__":
    main()
