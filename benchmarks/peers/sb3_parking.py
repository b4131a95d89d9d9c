"""Stable-Baselines3's side of ``parking_speed.py``: SAC with hindsight replay on highway-env's parking-v0.

Runs in an environment of its own that has stable-baselines3 and highway-env; prints one JSON object.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from importlib.metadata import version

import gymnasium as gym
import highway_env
import torch
from stable_baselines3 import SAC, HerReplayBuffer

gym.register_envs(highway_env)
PACKAGES = ("stable-baselines3", "torch", "gymnasium", "highway-env", "numpy")


def timed(function):
    """Returns ``function`` with an attribute ``seconds``: the wall time spent in it so far."""

    def call(*args, **kwargs):
        began = time.perf_counter()
        try:
            return function(*args, **kwargs)
        finally:
            call.seconds += time.perf_counter() - began

    call.seconds = 0.0
    return call


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--warm-up", type=int, required=True, help="environment steps before the clock starts")
    parser.add_argument("--steps", type=int, required=True, help="environment steps that are timed")
    parser.add_argument("--threads", type=int, default=0, help="torch's threads; 0 leaves torch's default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--settings", type=json.loads, required=True, help="hyper-parameters as JSON")
    arguments = parser.parse_args()
    if arguments.threads:
        torch.set_num_threads(arguments.threads)

    env = gym.make("parking-v0")
    env.step, env.reset = timed(env.step), timed(env.reset)
    model = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        seed=arguments.seed,
        device="cpu",
        **arguments.settings,
    )
    marks = {}

    def mark(local_names, _):
        steps = local_names["self"].num_timesteps
        if steps in (arguments.warm_up, arguments.warm_up + arguments.steps):
            marks[steps] = (time.perf_counter(), env.step.seconds, env.reset.seconds, model._n_updates)
        return True

    model.learn(arguments.warm_up + arguments.steps, callback=mark)
    first, last = marks[arguments.warm_up], marks[arguments.warm_up + arguments.steps]
    seconds, step_seconds, reset_seconds, updates = (b - a for a, b in zip(first, last, strict=True))
    print(
        json.dumps(
            {
                "steps": arguments.steps,
                "updates": updates,
                "seconds": seconds,
                "step_seconds": step_seconds,
                "reset_seconds": reset_seconds,
                "compile_seconds": 0.0,
                "threads": torch.get_num_threads(),
                "versions": {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}},
            }
        )
    )


if __name__ == "__main__":
    main()
