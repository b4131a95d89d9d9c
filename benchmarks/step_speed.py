"""Milliseconds per environment step of training, against Stable-Baselines3 and SBX, in one run on one machine.

    python benchmarks/step_speed.py --sb3-python PATH --sbx-python PATH

The paths are interpreters of virtual environments with ``stable-baselines3==2.9.2`` and ``sbx-rl==0.28.0``. One Gymnasium
environment, one gradient step a step, the same networks and batches in all libraries: SAC on Pendulum-v1 with 64-64 and
batches of 64; DDPG and TD3 on Pendulum-v1 and DQN on MountainCar-v0 with 128-128 and batches of 128. Every case runs in a
process of its own, the libraries in turn, several rounds; the clock starts after warm-up and compilation. Stable-Baselines3
runs with one torch thread, which is its faster setting for networks of this size. Medians and ratios are written to
``benchmarks/results/step_speed.json``.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import subprocess
import sys
import time
from pathlib import Path
from statistics import median

RESULT = Path(__file__).parent / "results" / "step_speed.json"
CASES = {
    "SAC": ("Pendulum-v1", {"batch_size": 64, "policy_kwargs": {"net_arch": [64, 64]}}),
    "DDPG": ("Pendulum-v1", {"batch_size": 128, "policy_kwargs": {"net_arch": [128, 128]}}),
    "TD3": ("Pendulum-v1", {"batch_size": 128, "policy_kwargs": {"net_arch": [128, 128]}}),
    "DQN": ("MountainCar-v0", {"batch_size": 128, "policy_kwargs": {"net_arch": [128, 128]}, "train_freq": 1}),
}
LIBRARIES = ("rejeu", "sb3", "sbx")


def child(library: str, algorithm: str, warm_up: int, steps: int) -> None:
    """Trains and prints seconds per step as JSON."""
    import gymnasium as gym

    env_id, settings = CASES[algorithm]
    settings = {**settings, "learning_starts": 100, "buffer_size": 100_000, "seed": 0}
    env = gym.make(env_id)
    if library == "rejeu":
        import rejeu

        agent = getattr(rejeu, algorithm)("MlpPolicy", env, **settings)
    elif library == "sb3":
        import stable_baselines3
        import torch

        torch.set_num_threads(1)
        agent = getattr(stable_baselines3, algorithm)("MlpPolicy", env, **settings)
    else:
        import sbx

        agent = getattr(sbx, algorithm)("MlpPolicy", env, **settings)
    agent.learn(warm_up)
    began = time.perf_counter()
    agent.learn(steps, reset_num_timesteps=False)
    print(json.dumps({"ms": (time.perf_counter() - began) / steps * 1e3}))


def measure(python: str, library: str, algorithm: str, warm_up: int, steps: int) -> float:
    command = [python, __file__, "--child", library, algorithm, "--warm-up", str(warm_up), "--steps", str(steps)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ})
    if done.returncode:
        raise SystemExit(f"{library} {algorithm} failed:\n{done.stderr[-2000:]}")
    return float(json.loads(done.stdout.strip().splitlines()[-1])["ms"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--child", nargs=2, metavar=("LIBRARY", "ALGORITHM"), help=argparse.SUPPRESS)
    parser.add_argument("--sb3-python")
    parser.add_argument("--sbx-python")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--warm-up", type=int, default=600)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--algorithms", nargs="+", default=list(CASES))
    arguments = parser.parse_args()
    if arguments.child:
        child(*arguments.child, arguments.warm_up, arguments.steps)
        return
    pythons = {"rejeu": sys.executable, "sb3": arguments.sb3_python, "sbx": arguments.sbx_python}
    pythons = {library: python for library, python in pythons.items() if python}
    samples: dict[str, dict[str, list[float]]] = {a: {library: [] for library in pythons} for a in arguments.algorithms}
    for _ in range(arguments.rounds):
        for algorithm in arguments.algorithms:
            for library, python in pythons.items():
                ms = measure(python, library, algorithm, arguments.warm_up, arguments.steps)
                samples[algorithm][library].append(ms)
                print(f"{algorithm} {library} {ms:.3f} ms", flush=True)
    result = {
        "command": shlex.join(["python", "benchmarks/step_speed.py", *sys.argv[1:]])
        .replace(arguments.sb3_python or " ", "SB3_PYTHON")
        .replace(arguments.sbx_python or " ", "SBX_PYTHON"),
        "machine": {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()},
        "milliseconds": samples,
        "medians": {a: {library: median(v) for library, v in by.items()} for a, by in samples.items()},
        "ratios": {
            a: {
                library: median(peer / own for peer, own in zip(v, by["rejeu"], strict=True))
                for library, v in by.items()
                if library != "rejeu"
            }
            for a, by in samples.items()
        },
    }
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(result["medians"]), json.dumps(result["ratios"]))


if __name__ == "__main__":
    main()
