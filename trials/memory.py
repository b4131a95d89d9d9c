"""Trains, evaluates, saves and loads many agents one after another, and says how the memory of the process grows.

    python trials/memory.py
    python trials/memory.py --rounds 30 --host

Each round makes a new agent in an environment in JAX, trains it in one program on the device (``--host``: with the loop of
the host), evaluates it, saves it, loads the file and drops everything. The agents are PPO and SAC in turn. The process may
grow by at most 50 MiB from round 10 on. Requires psutil.
"""

from __future__ import annotations

import argparse
import gc
import sys
import tempfile
from pathlib import Path

import psutil

import rejeu

MOST_MIB = 50


def one_round(number: int, path: Path, on_device: bool) -> None:
    """Trains, evaluates, saves and loads an agent."""
    agent_class, env = [(rejeu.PPO, "jax/CartPole-v1"), (rejeu.SAC, "jax/Pendulum-v1")][number % 2]
    settings = {"n_steps": 64} if agent_class is rejeu.PPO else {"buffer_size": 2000, "learning_starts": 100}
    agent = agent_class("MlpPolicy", env, seed=number, policy_kwargs={"net_arch": [16]}, **settings)
    agent.on_device = on_device
    agent.learn(512)
    agent.evaluate(2)
    agent.save(path)
    rejeu.load(path, env=env).evaluate(2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=100)
    parser.add_argument("--host", action="store_true", help="train with the loop of the host")
    arguments = parser.parse_args()
    mib: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(arguments.rounds):
            one_round(number, Path(folder) / "agent.safetensors", not arguments.host)
            gc.collect()
            mib.append(psutil.Process().memory_info().rss / 2**20)
            if number % 10 == 9:
                print(f"round {number + 1}: {mib[-1]:.0f} MiB", flush=True)
    growth = mib[-1] - mib[min(9, len(mib) - 1)]
    print(f"{growth:+.0f} MiB since round 10, at most {MOST_MIB} are allowed")
    sys.exit(growth > MOST_MIB)


if __name__ == "__main__":
    main()
