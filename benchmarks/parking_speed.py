"""How fast SAC with hindsight replay learns to park, against Stable-Baselines3, in one run on one machine.

    python benchmarks/parking_speed.py --peer-python PATH

``PATH`` is the interpreter of another virtual environment with ``stable-baselines3==2.9.2`` and ``highway-env``. All
cases have the hyper-parameters of ``SETTINGS``, hence one gradient step per environment step, and take turns, several
rounds of them, each in a process of its own:

- Stable-Baselines3 on highway-env's ``parking-v0``, with one torch thread and with torch's default; the faster counts;
- rejeu on the same environment, made by the same ``gymnasium.make("parking-v0")``;
- rejeu on EnvPool's ``parking-v0``, with several numbers of environments; the fastest counts.

The clock starts after the random steps, the compilation and some hundred gradient steps. Time is split into what the
environment's ``step`` and ``reset`` took and the rest, by the same wrapper around them in either library. For rejeu,
steps overlap with the update, which runs in XLA's threads: the rest is then the time by which a step is longer than the
environment's own. Compilation is timed with the compilation cache off, and reported apart.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path
from statistics import median

HERE = Path(__file__).resolve().parent
SETTINGS = {
    "replay_buffer_kwargs": {"n_sampled_goal": 4, "goal_selection_strategy": "future"},
    "learning_starts": 1000,
    "buffer_size": 50_000,
    "batch_size": 64,
    "policy_kwargs": {"net_arch": [64, 64]},
    "train_freq": 1,
    "gradient_steps": 1,
}
"""The notebook's; everything else is each library's default, which is the same."""
WARM_UP = SETTINGS["learning_starts"] + 512
"""Environment steps before the clock starts."""
ENVPOOL_ENVS = (8, 16, 32)
SB3_THREADS = (1, 0)
TARGETS = {"envpool_speed_ratio": 20.0, "gymnasium_outside_step_ratio": 8.0}
"""What rejeu set out to reach: how many times faster, how many times less time outside ``env.step``."""


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


def run_rejeu(n_envs: int, backend: str, steps: int, seed: int) -> dict:
    """Trains rejeu in this process and returns its times."""
    import gymnasium as gym
    import highway_env
    import jax

    import rejeu
    from rejeu import compilation

    if backend == "envpool":
        env = rejeu.make_vector("parking-v0", n_envs, "envpool", seed=seed)
        env.step, env.reset_done = step, reset = timed(env.step), timed(env.reset_done)
    else:
        gym.register_envs(highway_env)
        env = gym.make("parking-v0")
        env.step, env.reset = step, reset = timed(env.step), timed(env.reset)
    agent = rejeu.SAC("MultiInputPolicy", env, replay_buffer_class=rejeu.HerReplayBuffer, seed=seed, **SETTINGS)
    marks = []

    def mark(agent, progress):
        if progress.step >= (WARM_UP, WARM_UP + steps)[len(marks)]:
            jax.block_until_ready(agent.state)
            now = time.perf_counter()
            marks.append((now, step.seconds, reset.seconds, agent.n_updates, progress.step, compilation.seconds()))
        return len(marks) < 2

    agent.learn(WARM_UP + steps + n_envs, callback=mark)
    seconds, step_seconds, reset_seconds, updates, taken, compiled = (b - a for a, b in zip(*marks, strict=True))
    packages = ("rejeu", "jax", "gymnasium", "highway-env", "envpool", "numpy")
    return {
        "steps": taken,
        "updates": updates,
        "seconds": seconds,
        "step_seconds": step_seconds,
        "reset_seconds": reset_seconds,
        "compile_seconds": marks[0][-1],
        "compile_seconds_while_timed": compiled,
        "versions": {"python": platform.python_version(), **{name: version(name) for name in packages}},
    }


def cases(peer_python: str, steps: dict[str, int]) -> dict[str, list[str]]:
    """Returns the command of each case by its name."""
    peer = [peer_python, str(HERE / "peers" / "sb3_parking.py"), "--settings", json.dumps(SETTINGS)]
    peer += ["--warm-up", str(WARM_UP), "--steps", str(steps["sb3"])]
    own = [sys.executable, str(Path(__file__).resolve()), "--case"]
    return {
        **{f"sb3, {n or 'default'} threads": [*peer, "--threads", str(n)] for n in SB3_THREADS},
        "rejeu, gymnasium": [*own, "gymnasium", "--envs", "1", "--steps", str(steps["gymnasium"])],
        **{
            f"rejeu, envpool, {n} envs": [*own, "envpool", "--envs", str(n), "--steps", str(steps["envpool"])]
            for n in ENVPOOL_ENVS
        },
    }


def run_case(command: list[str], seed: int) -> dict:
    """Runs one case in a process of its own and returns what it printed, with times per step in milliseconds."""
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": "", "PYTHONWARNINGS": "ignore"}
    done = subprocess.run([*command, "--seed", str(seed)], capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\n{done.stderr}")
    result = json.loads(done.stdout.strip().splitlines()[-1])
    per_step = 1000 / result["steps"]
    outside = result["seconds"] - result["step_seconds"]
    return result | {
        "steps_per_second": result["steps"] / result["seconds"],
        "ms": per_step * result["seconds"],
        "ms_in_step": per_step * result["step_seconds"],
        "ms_in_reset": per_step * result["reset_seconds"],
        "ms_outside_step": per_step * outside,
        "ms_outside_step_and_reset": per_step * (outside - result["reset_seconds"]),
    }


def summarise(rounds: list[dict[str, dict]]) -> dict:
    """Returns the medians of each case over the rounds, and the ratios, each the median of the ratios of the rounds."""
    keys = ("steps_per_second", "ms", "ms_in_step", "ms_in_reset", "ms_outside_step", "ms_outside_step_and_reset")
    keys += ("compile_seconds",)
    medians = {name: {key: round(median(turn[name][key] for turn in rounds), 4) for key in keys} for name in rounds[0]}
    for name, row in medians.items():
        speeds = [round(turn[name]["steps_per_second"], 1) for turn in rounds]
        row["steps_per_second_range"] = [min(speeds), max(speeds)]
    fastest = lambda start: max(  # noqa: E731
        (name for name in medians if name.startswith(start)), key=lambda name: medians[name]["steps_per_second"]
    )
    peer, pool, own = fastest("sb3"), fastest("rejeu, envpool"), "rejeu, gymnasium"
    ratio = lambda top, bottom, key: round(median(t[top][key] / t[bottom][key] for t in rounds), 2)  # noqa: E731
    ratios = {
        "envpool_speed_ratio": ratio(pool, peer, "steps_per_second"),
        "gymnasium_speed_ratio": ratio(own, peer, "steps_per_second"),
        "gymnasium_outside_step_ratio": ratio(peer, own, "ms_outside_step"),
        "gymnasium_outside_step_and_reset_ratio": ratio(peer, own, "ms_outside_step_and_reset"),
    }
    reached = {key: bool(ratios[key] >= least) for key, least in TARGETS.items()}
    return {
        "cases": medians,
        "peer": peer,
        "fastest_envpool": pool,
        "ratios": ratios,
        "targets": TARGETS,
        "reached": reached,
    }


def machine() -> dict:
    """Returns what the figures were measured on."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = info.read_text().splitlines()
        model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), model)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    load = round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None
    return {"cpu": model, "cores": cores, "system": platform.system(), "load_before": load}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer-python", help="interpreter that has stable-baselines3 and highway-env")
    parser.add_argument("--rounds", type=int, default=5, help="turns of every case")
    parser.add_argument("--quick", action="store_true", help="one short round: to see that it runs, not to be quoted")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "parking_speed.json")
    parser.add_argument("--case", choices=("gymnasium", "envpool"), help=argparse.SUPPRESS)
    parser.add_argument("--envs", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--steps", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--seed", type=int, default=0, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.case:
        print(json.dumps(run_rejeu(arguments.envs, arguments.case, arguments.steps, arguments.seed)))
        return
    if arguments.peer_python is None:
        parser.error("--peer-python is needed")

    steps = {"sb3": 3_000, "gymnasium": 3_000, "envpool": 32_000}
    n_rounds = arguments.rounds
    if arguments.quick:
        steps, n_rounds = {"sb3": 300, "gymnasium": 300, "envpool": 3_200}, 1
    described, rounds = machine(), []
    for seed in range(n_rounds):
        rounds.append({})
        for name, command in cases(arguments.peer_python, steps).items():
            rounds[-1][name] = result = run_case(command, seed)
            print(
                f"round {seed + 1}/{n_rounds}  {name:<24} {result['steps_per_second']:8.0f} steps/s  "
                f"{result['ms_in_step']:6.3f} ms in step, {result['ms_in_reset']:6.3f} in reset, "
                f"{result['ms_outside_step_and_reset']:6.3f} elsewhere",
                flush=True,
            )
    summary = summarise(rounds)
    versions = {name: result.pop("versions") for name, result in rounds[0].items()}
    for turn in rounds[1:]:
        for result in turn.values():
            result.pop("versions")
    command = ["python", "benchmarks/parking_speed.py", "--peer-python", "PATH"]
    command += ["--quick"] if arguments.quick else ["--rounds", str(n_rounds)]
    report = {
        "command": " ".join(command),
        "quick": arguments.quick,
        "machine": described,
        "settings": SETTINGS,
        "warm_up_steps": WARM_UP,
        "summary": summary,
        "versions": {
            "sb3": next(v for name, v in versions.items() if name.startswith("sb3")),
            "rejeu": versions["rejeu, gymnasium"],
        },
        "rounds": rounds,
    }
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(summary["ratios"] | {"reached": summary["reached"]}, indent=1))


if __name__ == "__main__":
    main()
