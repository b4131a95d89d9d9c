"""Drives episodes of highway-env's parking-v0 by a policy exported to C and by ``predict``, from the same seeds.

    rejeu train parking-v0 --seed 0 --out FOLDER
    python trials/parking_c.py FOLDER [EPISODES]

The C file gets every observation of its episode in the moment in which the environment gives it, from a process that stays
open. Results are written to ``trials/results/parking_c.json``.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from provenance import machine, provenance, write

import rejeu
from rejeu.export.c_file import main_of
from rejeu.runs.config import versions

RESULTS = Path(__file__).parent / "results" / "parking_c.json"
FLAGS = ("-O2", "-std=c99", "-Wall", "-Wextra", "-Werror")


def drive(env: gym.Env[Any, Any], act: Callable[[Any], np.ndarray], seed: int) -> tuple[bool, float, int]:
    """Returns success, return and steps of an episode."""
    obs, info = env.reset(seed=seed)
    total, steps, ended = 0.0, 0, False
    while not ended:
        obs, reward, terminated, truncated, info = env.step(act(obs))
        total, steps, ended = total + float(reward), steps + 1, terminated or truncated
    return bool(info["is_success"]), round(total, 4), steps


def main(model: Path, n: int) -> int:
    """Drives the episodes and writes the results."""
    import highway_env

    gym.register_envs(highway_env)
    env, agent = gym.make("parking-v0"), rejeu.load(model)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        found = agent.export(folder / "policy.c")
        one = rejeu.agents.exporting.policy_for(agent, False, 1)
        (folder / "main.c").write_bytes(main_of(one, "policy"))
        compilers = [one for one in ("gcc", "clang") if shutil.which(one)]
        for compiler in reversed(compilers):  # the first one's program is driven
            subprocess.run([compiler, *FLAGS, "-c", "policy.c"], cwd=folder, check=True)
            subprocess.run([compiler, "-O2", "main.c", "policy.o", "-lm", "-o", "main"], cwd=folder, check=True)
        names = [(port.name, port.dtype) for port in one.of("observation")]
        with subprocess.Popen([folder / "main"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0) as process:

            def by_c(obs: Any) -> np.ndarray:
                process.stdin.write(b"".join(np.asarray(obs[key], dtype).tobytes() for key, dtype in names))
                return np.frombuffer(process.stdout.read(16)[:8], np.float32)  # then the seconds

            def by_predict(obs: Any) -> np.ndarray:
                return agent.predict(obs, deterministic=True)[0]

            rows = [[drive(env, act, seed) for act in (by_c, by_predict)] for seed in range(n)]
    result = {
        "episodes": n,
        "compilers": compilers,
        "successes": {who: sum(row[i][0] for row in rows) for i, who in enumerate(("C", "predict"))},
        "episodes with equal success": sum(a[0] == b[0] for a, b in rows),
        "episodes with equal steps": sum(a[2] == b[2] for a, b in rows),
        "largest difference of returns": max(abs(a[1] - b[1]) for a, b in rows),
        "largest difference of actions": found.check.difference if found.check else None,
    }
    print(result)
    write(RESULTS, {**provenance({str(model): "FOLDER"}), "machine": machine(), "versions": versions(), **result})
    return int(result["successes"]["C"] != result["successes"]["predict"])


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 100))
