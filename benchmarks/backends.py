"""Environment steps per second of each backend, for the environments that have presets and for LunarLander.

    python benchmarks/backends.py

Random actions, resets included, measured as ``backend="auto"`` measures (``rejeu.envs.measuring``), in several rounds whose
median counts. Worker processes are measured where a step in this process takes a millisecond or more. Written to
``benchmarks/results/backends.json``, and printed as the table of ``docs/environments.md``.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import sys
from pathlib import Path
from statistics import median

import rejeu
from rejeu.cli.run_folder import versions
from rejeu.envs import measuring
from rejeu.envs.envpool import envpool_knows
from rejeu.envs.measuring import Choice

RESULT = Path(__file__).parent / "results" / "backends.json"
CASES = {
    "CartPole-v1": (1, 4, 16),
    "Pendulum-v1": (1, 4, 16),
    "MountainCar-v0": (1, 16),
    "LunarLander-v3": (1, 16),
    "LunarLanderContinuous-v3": (1, 16),
    "FetchReach-v4": (1, 4),
    "parking-v0": (1, 16),
    "rejeu/Ball-v0": (8,),
}
"""Numbers of environments to measure with."""


def measure(env_id: str, n_envs: int, rounds: int) -> dict[str, float]:
    def make(backend: str, n: int) -> rejeu.envs.VectorEnv:
        return rejeu.make_vector(env_id, n, backend, seed=0)

    def several(backends: tuple[str, ...]) -> dict[str, float]:
        found = [measuring.measure(make, backends, n_envs) for _ in range(rounds)]
        for choice in found:
            assert not choice.passed_over, choice.passed_over
        return {backend: median(choice.measured[backend] for choice in found) for backend in backends}

    rates = several(("envpool", "gymnasium") if envpool_knows(env_id) else ("gymnasium",))
    if n_envs > 1 and rates["gymnasium"] * measuring.SLOW_STEP < 1.0:
        rates |= several(("gymnasium-async",))
    return rates


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=7)
    rounds = parser.parse_args().rounds
    rows = [
        {"env": env_id, "n_envs": n, "steps_per_second": {k: round(v) for k, v in measure(env_id, n, rounds).items()}}
        for env_id, numbers in CASES.items()
        for n in numbers
    ]
    machine = {
        "processor": platform.processor() or platform.machine(),
        "cores": measuring.cores(),
        "load": os.getloadavg()[0],
    }
    command = shlex.join(["python", *sys.argv])
    RESULT.write_text(
        json.dumps({"command": command, "machine": machine, "versions": versions(), "results": rows}, indent=1) + "\n"
    )
    print("| environment | at once | EnvPool | this process | workers | `auto` takes |\n|---|---|---|---|---|---|")
    for row in rows:
        rates = row["steps_per_second"]
        cells = [f"{rates[backend]:,}" if backend in rates else "" for backend in measuring.PREFERENCE]
        print(
            f"| `{row['env']}` | {row['n_envs']} | {' | '.join(cells)} | {measuring.fastest(Choice('', rates)).backend} |"
        )


if __name__ == "__main__":
    main()
