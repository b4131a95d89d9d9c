"""Compares the training speed of two checkouts of rejeu, whose processes take turns.

    python benchmarks/pairs.py --base PATH --new PATH --pairs 5
    python benchmarks/pairs.py --base PATH --new PATH --only SAC TD3

Both processes train the same agent. Each in turn trains for a second or two while the other waits, so that a machine whose
speed changes slows both down. A pair is two new processes; its ratio is the median over the turns, and the result is the
median over the pairs. Results go to ``benchmarks/results/pairs.json``.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import commit, read, write

RESULT = Path(__file__).parent / "results" / "pairs.json"
STEPS = {"SAC": 1000, "DDPG": 800, "TD3": 800, "DQN": 1000, "PPO": 8192, "parking": 1600}
"""Environment steps of a turn."""
TURNS = 10


def make(case: str) -> Any:
    import rejeu

    small, middle = ({"batch_size": n, "policy_kwargs": {"net_arch": [n, n]}} for n in (64, 128))
    common: dict[str, Any] = {"seed": 0, "learning_starts": 200}

    def env(name: str, n_envs: int = 1, backend: str = "gymnasium") -> Any:
        return rejeu.make_vector(name, n_envs=n_envs, backend=backend)

    if case == "PPO":
        return rejeu.PPO("MlpPolicy", env("LunarLanderContinuous-v3", 16), n_steps=128, batch_size=64, seed=0)
    if case == "parking":
        goals = {"n_sampled_goal": 4, "goal_selection_strategy": "future"}
        hindsight = {"replay_buffer_class": rejeu.HerReplayBuffer, "replay_buffer_kwargs": goals}
        parking = env("parking-v0", 8, "envpool")
        return rejeu.SAC(
            "MultiInputPolicy", parking, learning_starts=1000, gradient_steps=-1, seed=0, **hindsight, **small
        )
    if case == "DQN":
        more = {"train_freq": 1, "target_update_interval": 1000, "exploration_initial_eps": 0.05, "learning_rate": 1e-4}
        return rejeu.DQN("MlpPolicy", env("MountainCar-v0"), **common, **more, **middle)
    if case == "SAC":
        return rejeu.SAC("MlpPolicy", env("Pendulum-v1"), **common, **small)
    return getattr(rejeu, case)("MlpPolicy", env("Pendulum-v1"), action_noise=0.1, **common, **middle)


def work(case: str) -> None:
    """Trains for one turn per line of standard input, and prints steps per second of wall and of processor time."""
    warnings.simplefilter("ignore")
    agent, steps = make(case), STEPS[case]
    agent.learn(max(2500, steps))
    print("ready", flush=True)
    for _ in sys.stdin:
        wall, processor = time.perf_counter(), time.process_time()
        agent.learn(steps, reset_num_timesteps=False)
        print(steps / (time.perf_counter() - wall), steps / (time.process_time() - processor), flush=True)


def start(case: str, checkout: Path) -> subprocess.Popen[str]:
    command = [sys.executable, __file__, "--work", case]
    path = {**os.environ, "PYTHONPATH": str(checkout / "src")}
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=path)
    assert process.stdout is not None
    while (line := process.stdout.readline()) != "ready\n":
        if not line:
            raise SystemExit(f"{checkout} ended before it was ready")
    return process


def turn(process: subprocess.Popen[str]) -> tuple[float, float]:
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("go\n")
    process.stdin.flush()
    wall, processor = map(float, process.stdout.readline().split())
    return wall, processor


def pair(case: str, base: Path, new: Path, swapped: bool) -> dict[str, float]:
    """Returns the median steps per second of both, and the median ratios of new to base."""
    order = [("new", new), ("base", base)] if swapped else [("base", base), ("new", new)]
    processes = {name: start(case, checkout) for name, checkout in order}
    speeds: dict[str, list[tuple[float, float]]] = {"base": [], "new": []}
    for i in range(TURNS):
        for name in ("base", "new") if i % 2 else ("new", "base"):
            speeds[name].append(turn(processes[name]))
    for process in processes.values():
        process.communicate()
    ratios = [(n[0] / b[0], n[1] / b[1]) for b, n in zip(speeds["base"], speeds["new"], strict=True)]
    return {
        "base": round(statistics.median(wall for wall, _ in speeds["base"])),
        "new": round(statistics.median(wall for wall, _ in speeds["new"])),
        "ratio": round(statistics.median(wall for wall, _ in ratios), 3),
        "processor_ratio": round(statistics.median(processor for _, processor in ratios), 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--base", type=Path)
    parser.add_argument("--new", type=Path)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--only", nargs="*", choices=STEPS, default=[*STEPS])
    parser.add_argument("--work", choices=STEPS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.work:
        return work(arguments.work)
    results = read(RESULT)
    for case in arguments.only:
        pairs = [pair(case, arguments.base, arguments.new, bool(i % 2)) for i in range(arguments.pairs)]
        results[case] = {
            **{name: commit(getattr(arguments, name)) for name in ("base", "new")},
            "date": time.strftime("%Y-%m-%d"),
            "ratio": round(statistics.median(speeds["ratio"] for speeds in pairs), 3),
            "processor_ratio": round(statistics.median(speeds["processor_ratio"] for speeds in pairs), 3),
            "pairs": pairs,
        }
        print(case, results[case]["ratio"], results[case]["processor_ratio"], flush=True)
        write(RESULT, results)
    return None


if __name__ == "__main__":
    main()
