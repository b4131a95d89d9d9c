"""Environment steps per second of PPO, against Stable-Baselines3 and SBX, in one run on one machine.

    python benchmarks/rollout_speed.py --sb3-python PATH --sbx-python PATH

The paths are interpreters of virtual environments with ``stable-baselines3==2.9.2`` and ``sbx-rl==0.28.0``, each with
``gymnasium[box2d]``. All train PPO on LunarLanderContinuous-v3 with 16 environments stepped in the process, rollouts of 2048
steps in all, batches of 64, 5 epochs and 64-64 networks; rejeu also on EnvPool, and with 1 to 64 environments on either
backend, rollouts of 2048 steps in all throughout. Stable-Baselines3 and SBX run with one torch thread and with torch's
default, and the faster counts. Every case runs in a process of its own, in turns, several rounds; the clock starts after
warm-up and compilation. Medians and ratios are written to ``benchmarks/results/rollout_speed.json``, and the growth with the
number of environments is drawn to ``docs/images/rollout-speed.png``.
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

HERE = Path(__file__).resolve().parent
RESULT = HERE / "results" / "rollout_speed.json"
PICTURE = HERE.parent / "docs" / "images" / "rollout-speed.png"
ENV = "LunarLanderContinuous-v3"
SETTINGS = {"batch_size": 64, "n_epochs": 5, "policy_kwargs": {"net_arch": [64, 64]}, "seed": 0}
STEPS_PER_ROLLOUT = 2048
MANY = 16
"""Environments of the comparison."""
GROWTH = (1, 2, 4, 8, 16, 32, 64)
TARGETS = {"gymnasium": 4.0, "envpool": 7.0}
"""What rejeu set out to reach: how many times faster than the faster peer."""


def child(library: str, backend: str, n_envs: int, threads: int, steps: int) -> None:
    """Trains and prints steps per second as JSON."""
    settings = {**SETTINGS, "n_steps": STEPS_PER_ROLLOUT // n_envs}
    if library == "rejeu":
        import rejeu

        agent = rejeu.PPO("MlpPolicy", rejeu.make_vector(ENV, n_envs, backend, seed=0), **settings)
        wait = lambda: agent.state  # noqa: E731
    else:
        import gymnasium as gym
        import torch
        from stable_baselines3.common.vec_env import DummyVecEnv

        if threads:
            torch.set_num_threads(threads)
        env = DummyVecEnv([lambda: gym.make(ENV)] * n_envs)
        if library == "sb3":
            from stable_baselines3 import PPO

            agent = PPO("MlpPolicy", env, device="cpu", **settings)
        else:
            from sbx import PPO

            agent = PPO("MlpPolicy", env, **settings)
        wait = lambda: None  # noqa: E731
    agent.learn(2 * STEPS_PER_ROLLOUT)
    wait()
    began = time.perf_counter()
    agent.learn(steps, reset_num_timesteps=False)
    wait()
    print(json.dumps({"steps_per_second": steps / (time.perf_counter() - began)}))


def measure(python: str, library: str, backend: str, n_envs: int, threads: int) -> float:
    """Runs one case in a process of its own and returns its steps per second."""
    rollouts = (4 if library != "rejeu" else 20) if n_envs >= 8 else 4
    command = [python, __file__, "--child", library, backend, str(n_envs), str(threads)]
    command.append(str(rollouts * STEPS_PER_ROLLOUT))
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ})
    if done.returncode:
        raise SystemExit(f"{library} {backend} failed:\n{done.stderr[-2000:]}")
    rate = float(json.loads(done.stdout.strip().splitlines()[-1])["steps_per_second"])
    print(f"{library:6s} {backend:10s} {n_envs:3d} envs  {rate:9,.0f} steps/s", flush=True)
    return rate


def compare(pythons: dict[str, str], rounds: int) -> dict:
    """Returns the steps per second of all libraries with :data:`MANY` environments, and the ratios."""
    own = {f"rejeu, {backend}": ("rejeu", backend, 0) for backend in TARGETS}
    peers = {
        f"{library}, {threads or 'default'} threads": (library, "gymnasium", threads)
        for library in ("sb3", "sbx")
        for threads in (1, 0)
    }
    rates: dict[str, list[float]] = {name: [] for name in [*peers, *own]}
    for _ in range(rounds):
        for name, (library, backend, threads) in [*peers.items(), *own.items()]:
            rates[name].append(measure(pythons[library], library, backend, MANY, threads))
    medians = {name: median(values) for name, values in rates.items()}
    best = {library: max(medians[name] for name in peers if name.startswith(library)) for library in ("sb3", "sbx")}
    ratios = {
        f"{backend} / {library}": medians[f"rejeu, {backend}"] / best[library]
        for backend in TARGETS
        for library in best
    }
    return {"steps_per_second": rates, "medians": medians, "ratios": ratios, "targets": TARGETS}


def grow(rounds: int) -> dict[str, dict[int, float]]:
    """Returns rejeu's median steps per second by backend and number of environments."""
    rates: dict[str, dict[int, list[float]]] = {backend: {n: [] for n in GROWTH} for backend in TARGETS}
    for _ in range(rounds):
        for backend in TARGETS:
            for n in GROWTH:
                rates[backend][n].append(measure(sys.executable, "rejeu", backend, n, 0))
    return {backend: {n: median(values) for n, values in by.items()} for backend, by in rates.items()}


def draw(growth: dict[str, dict[int, float]], peers: dict[str, float]) -> None:
    """Draws steps per second against the number of environments."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    for backend, by in growth.items():
        axes.plot(list(by), list(by.values()), marker="o", label=f"rejeu, {backend}")
    for name, rate in peers.items():
        axes.plot([MANY], [rate], marker="s", linestyle="none", label=name)
    axes.set_xscale("log", base=2)
    axes.set_xticks(GROWTH, [str(n) for n in GROWTH])
    axes.set_ylim(0)
    axes.set_xlabel("environments")
    axes.set_ylabel("environment steps per second")
    axes.set_title(f"PPO on {ENV}, {os.cpu_count()} cores")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(PICTURE, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--child", nargs=5, metavar=("LIBRARY", "BACKEND", "ENVS", "THREADS", "STEPS"), help=argparse.SUPPRESS
    )
    parser.add_argument("--sb3-python", help="interpreter with stable-baselines3 and gymnasium[box2d]")
    parser.add_argument("--sbx-python", help="interpreter with sbx-rl and gymnasium[box2d]")
    parser.add_argument("--rounds", type=int, default=3, help="turns of every case")
    arguments = parser.parse_args()
    if arguments.child:
        library, backend, n_envs, threads, steps = arguments.child
        child(library, backend, int(n_envs), int(threads), int(steps))
        return
    if not (arguments.sb3_python and arguments.sbx_python):
        parser.error("--sb3-python and --sbx-python are needed")
    pythons = {"rejeu": sys.executable, "sb3": arguments.sb3_python, "sbx": arguments.sbx_python}
    compared = compare(pythons, arguments.rounds)
    growth = grow(arguments.rounds)
    command = shlex.join(["python", "benchmarks/rollout_speed.py", *sys.argv[1:]])
    result = {
        "command": command.replace(arguments.sb3_python, "SB3_PYTHON").replace(arguments.sbx_python, "SBX_PYTHON"),
        "machine": {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()},
        "settings": {**SETTINGS, "env": ENV, "steps_per_rollout": STEPS_PER_ROLLOUT, "n_envs": MANY},
        **compared,
        "growth": growth,
    }
    RESULT.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    draw(growth, {name: rate for name, rate in compared["medians"].items() if not name.startswith("rejeu")})
    print(json.dumps(compared["ratios"], indent=1))


if __name__ == "__main__":
    main()
