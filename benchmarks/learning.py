"""Trains a preset on several seeds and records the results, which the documentation reports.

    python benchmarks/learning.py Pendulum-v1 SAC --seeds 0 1 2 3 4

Training is the same as with ``rejeu train``, but without periodic evaluations. The final weights are evaluated on 100
new episodes. In goal environments ``success_rate`` is the share of those that are at their goal in the last step, and
``reached_rate`` of those that were there in any step, as D4RL counts. With ``--best``, the agent is also evaluated during
training, as often as the preset specifies. The best weights of these evaluations are then evaluated on new episodes. The
results are written to ``benchmarks/results/learning/ENV-ALGO.json``, with the command, the commit, the versions and the
hyperparameters. ``--shown`` leaves of the observations only some components, which makes Pendulum partially observable, and
``--set`` changes hyperparameters of the preset::

    python benchmarks/learning.py Pendulum-v1 SAC --shown 0 1 --set '{"policy_kwargs": {"lstm_hidden_size": 64}}' --name NAME

With ``--zoo`` the hyperparameters are those of ``benchmarks/zoo.toml`` in the place of the preset's, and the results are in
``benchmarks/results/learning/zoo``. The file is written after every seed; ``--continue`` keeps the seeds that it has.
``--preset PPO`` takes the settings of that algorithm, where the algorithm itself has none for the environment, and
``--preset small`` those of a preset with that name, and ``--preset default`` those of ``rejeu train`` for an environment
without a preset.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import importlib.metadata
import json
import math
import sys
import time
import tomllib
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import jax
import numpy as np
from gymnasium.wrappers import TransformObservation

import rejeu
from rejeu.agents import presets
from rejeu.algorithms import config as configs
from rejeu.callbacks.evaluate import Evaluate, Evaluated
from rejeu.core import validation
from rejeu.core.records import convert
from rejeu.envs.base import Step
from rejeu.envs.make import VectorEnv, make_vector

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import half_interval, machine, provenance, read, write

ZOO = Path(__file__).parent / "zoo.toml"
RESULTS = Path(__file__).parent / "results" / "learning"


def train_one(preset: presets.Preset, seed: int, arguments: argparse.Namespace) -> dict:
    backend = arguments.backend or preset.backend
    began = time.perf_counter()

    def environments(n: int, seed: int, backend: str = backend) -> VectorEnv:
        if arguments.shown is None:
            return make_vector(preset.env_id, n, backend, seed, **arguments.env)
        return make_vector(lambda: partly_shown(preset.env_id, arguments.shown), n, "gymnasium", seed)

    env = environments(preset.n_envs, seed)
    nested = "Dict" in type(env.observation_space).__name__
    agent = rejeu.AGENTS[arguments.algorithm](
        "MultiInputPolicy" if nested else "MlpPolicy", env, seed=seed, **settings_of(preset, arguments)
    )
    callback = None
    if arguments.best or arguments.curve:
        test_env = environments(10, 2_000_000 + 100 * seed)
        every = arguments.curve or preset.evaluate_every
        callback = Evaluate(test_env, every, preset.evaluate_episodes, report=partial(print_evaluation, seed))
    steps, minutes = arguments.steps or (None if arguments.minutes else preset.total_steps), arguments.minutes
    remaining_minutes = minutes and minutes - (time.perf_counter() - began) / 60
    agent.learn(steps, callback=callback, minutes=remaining_minutes)
    seconds = time.perf_counter() - began
    if max(agent.num_timesteps / (steps or math.inf), seconds / (60 * (minutes or math.inf))) < 0.99:
        raise SystemExit(
            f"seed {seed} was cut short after {seconds:.0f} s and {agent.num_timesteps:,} steps; nothing is recorded"
        )
    if arguments.best:
        agent.restore_best()
    if arguments.keep is not None:
        arguments.keep.mkdir(parents=True, exist_ok=True)
        agent.save(arguments.keep / f"{preset.env_id.replace('/', '-')}-{arguments.algorithm}-{seed}.safetensors")
    evaluation_env = environments(10, 1_000_000 + 100 * seed, arguments.evaluation_backend or backend)
    reached = record_reached(evaluation_env)
    evaluation = agent.evaluate(arguments.episodes, env=evaluation_env)
    counted = [flag for i, flags in enumerate(reached) for flag in flags[: (arguments.episodes + i) // 10]]
    return {
        "seed": seed,
        "steps": agent.num_timesteps,
        "n_updates": agent.n_updates,
        "seconds": round(seconds, 1),
        "mean_return": evaluation.mean_return,
        "std_return": evaluation.std_return,
        "mean_length": evaluation.mean_length,
        "success_rate": None if math.isnan(evaluation.success_rate) else evaluation.success_rate,
        **({"reached_rate": float(np.mean(counted))} if nested and not math.isnan(evaluation.success_rate) else {}),
        "episodes": arguments.episodes,
        **(curves_of(callback) if callback else {}),
    }


def record_reached(env: VectorEnv) -> list[list[bool]]:
    """Returns a list for each environment, to which every episode adds whether it reached its goal at any of its steps."""
    step_all, episodes, running = env.step, [[] for _ in range(env.n_envs)], [False] * env.n_envs

    def step(action: np.ndarray, active: np.ndarray | None = None) -> Step:
        result = step_all(action, active)
        for i, ended in enumerate(result.terminated | result.truncated):
            running[i] |= env.success(result, i) == 1.0
            if ended:
                episodes[i].append(running[i])
                running[i] = False
        return result

    env.step = step  # type: ignore[method-assign]
    return episodes


def print_evaluation(seed: int, evaluated: Evaluated, is_best: bool) -> None:
    """Prints an evaluation on the way, so that a long run can be followed."""
    result = evaluated.evaluation
    print(
        f"seed {seed}, step {evaluated.step:,}: return {result.mean_return:.1f}, success {result.success_rate:.2f}",
        flush=True,
    )


def curves_of(callback: Evaluate) -> dict[str, list]:
    """Returns the mean return at each evaluation, and for goals the share of episodes that succeeded."""
    points = [(evaluated.step, evaluated.evaluation) for evaluated in callback.results]
    success = [
        [step, evaluation.success_rate] for step, evaluation in points if not math.isnan(evaluation.success_rate)
    ]
    return {
        "curve": [[step, evaluation.mean_return] for step, evaluation in points],
        **({"success_curve": success} if success else {}),
    }


def partly_shown(env_id: str, shown: list[int]) -> gym.Env:
    """Returns an environment of whose observations only some components are shown."""
    env = gym.make(env_id)
    space = env.observation_space
    return TransformObservation(env, lambda obs: obs[shown], gym.spaces.Box(space.low[shown], space.high[shown]))


def settings_of(preset: presets.Preset, arguments: argparse.Namespace) -> dict[str, Any]:
    """Returns the hyperparameters of a preset with the overrides of ``--set``, into which dicts are merged.

    None removes a hyperparameter of the preset that this algorithm does not have.
    """
    before = preset.hyperparameters
    overrides = {k: {**before.get(k, {}), **v} if isinstance(v, dict) else v for k, v in arguments.set.items()}
    field_names = {field.name for field in dataclasses.fields(rejeu.AGENTS[arguments.algorithm].algorithm.Config)}
    return {name: value for name, value in {**before, **overrides}.items() if value is not None or name in field_names}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env_id")
    parser.add_argument("algorithm")
    parser.add_argument(
        "--preset", metavar="NAME", help="algorithm or preset whose settings are used; default: its own"
    )
    parser.add_argument("--import", dest="imported", metavar="MODULE", help="that registers environments and presets")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--steps", type=int)
    parser.add_argument("--minutes", type=float, help="train at most so long, everything from making the agent counted")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--backend")
    parser.add_argument("--evaluation-backend", help="of the last evaluation; default: as in training")
    parser.add_argument("--env", type=json.loads, default={}, help="arguments of the environment, as JSON")
    parser.add_argument("--set", type=json.loads, default={}, help="hyperparameters other than the preset's, as JSON")
    parser.add_argument("--best", action="store_true", help="evaluate the best weights by evaluations on the way")
    parser.add_argument("--curve", type=int, metavar="STEPS", help="evaluate and record also every so many steps")
    parser.add_argument(
        "--shown", type=int, nargs="+", help="components of the observation that are shown; default: all"
    )
    parser.add_argument("--name", help="of the result file")
    parser.add_argument("--zoo", action="store_true", help="with the hyperparameters of RL Zoo in benchmarks/zoo.toml")
    parser.add_argument("--continue", action="store_true", dest="goes_on", help="keep the seeds of the result file")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="save the trained agents there")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the result file")
    arguments = parser.parse_args()
    if arguments.imported:
        importlib.import_module(arguments.imported)
    find = zoo if arguments.zoo else presets.find
    of = arguments.preset or arguments.algorithm
    if of == "default":
        preset = presets.default(arguments.env_id, arguments.algorithm, presets.small(arguments.algorithm))
    else:
        preset = find(arguments.env_id, of) or presets.named(of, arguments.env_id, arguments.algorithm)
    if preset is None:
        parser.error(f"there is no preset of {of} for {arguments.env_id}")
    preset = dataclasses.replace(preset, env_id=arguments.env_id)
    name = arguments.name or f"{arguments.env_id.replace('/', '-')}-{arguments.algorithm}"
    path = arguments.out / ("zoo" if arguments.zoo else "") / f"{name}.json"
    runs: list[dict] = read(path).get("runs", []) if arguments.goes_on else []
    for seed in sorted({*arguments.seeds} - {run["seed"] for run in runs}):
        runs.append(train_one(preset, seed, arguments))
        print(json.dumps(runs[-1]), flush=True)
        write(path, described(preset, arguments, runs))
    print(json.dumps(described(preset, arguments, runs)["summary"]), "->", path)


def zoo(env_id: str, algorithm: str) -> presets.Preset | None:
    """Returns the hyperparameters of RL Zoo as a preset, None if they are not in ``benchmarks/zoo.toml``."""
    entries = tomllib.loads(ZOO.read_text(encoding="utf-8"))["preset"]
    zoo_presets = [convert(entry, presets.Preset) for entry in entries]
    return next((preset for preset in zoo_presets if (preset.env_id, preset.algorithm) == (env_id, algorithm)), None)


def described(preset: presets.Preset, arguments: argparse.Namespace, runs: list[dict]) -> dict[str, Any]:
    """Returns the runs with their origin and their summary."""
    config = validation.build(rejeu.AGENTS[arguments.algorithm].algorithm.Config, settings_of(preset, arguments))
    as_given = {name: arguments.set[name] for name in ("demonstrations",) if name in arguments.set}  # and no full path
    installed = {dist.name for dist in importlib.metadata.distributions()}
    versions = {name: importlib.metadata.version(name) for name in ("jax", "gymnasium", "envpool") if name in installed}
    return {
        **provenance({str(arguments.out): "FOLDER", str(arguments.keep): "FOLDER"}),
        "machine": {**machine(), "device": jax.devices()[0].device_kind},
        "versions": {"rejeu": rejeu.__version__, **versions},
        "hyperparameters": {**configs.to_json(config), **as_given},
        "n_envs": preset.n_envs,
        "backend": arguments.backend or preset.backend,
        "runs": runs,
        "summary": {key: summary([run[key] for run in runs]) for key in ("mean_return", "success_rate", "seconds")},
    }


def summary(values: list) -> dict | None:
    """Returns the mean, minimum and maximum over seeds, and the 95 % confidence interval of the mean (Student's t)."""
    if any(value is None for value in values):
        return None
    mean, n = float(np.mean(values)), len(values)
    half = half_interval(values)
    interval = [mean - half, mean + half] if n > 1 else None
    return {"mean": mean, "interval": interval, "least": min(values), "largest": max(values), "seeds": n}


if __name__ == "__main__":
    main()
