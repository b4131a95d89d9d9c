"""Measures how close a sweep comes to the ideal: the time of one run alone, times the runs, divided by the workers.

    python benchmarks/sweep.py
    python benchmarks/sweep.py --runs 4 --seconds 15 --only local --out /tmp/sweep.json

24 runs of about a minute (SAC on Pendulum-v1, one thread each) are trained by ``rejeu sweep --workers 2``, and by
``rejeu sweep --ray`` on a Ray cluster on this machine with as many CPUs. The times are those of whole commands, from their
start to their end.

What a run takes alone is measured in three ways, each several times: with the whole machine, where the environment steps on
one core while the update runs on another; on one core, which is the share of a run when there are as many workers as cores;
and two at once without a sweep. The shares of the ideal are relative to each, and to the times of the sweep's own processes.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from rejeu.experiments.process import environment

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import provenance, write

ROOT = Path(__file__).resolve().parents[1]
RESULT = ROOT / "benchmarks" / "results" / "sweep.json"
LOOPBACK = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_USAGE_STATS_ENABLED": "0"}
SETTINGS = {"policy_kwargs.net_arch": [64, 64], "batch_size": 128, "learning_starts": 100}
OPTIONS = {"evaluate_every": 1_000_000, "evaluate_episodes": 5}


def train_command(steps: int, seed: int, out: Path) -> list[str]:
    words = ["train", "Pendulum-v1", "--algo", "SAC", "--steps", str(steps), "--seed", str(seed), "--out", str(out)]
    words += ["--set", *(f"{name}={json.dumps(value)}" for name, value in SETTINGS.items())]
    for name, value in OPTIONS.items():
        words += [f"--{name.replace('_', '-')}", str(value)]
    return [sys.executable, "-m", "rejeu", *words, "--no-report", "--no-video"]


def on_one_core(steps: int, root: Path) -> float:
    """Trains one run that may use one core only; returns the seconds from start to end, NaN where cores cannot be chosen."""
    if not hasattr(os, "sched_setaffinity"):
        return math.nan
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})  # the process inherits it
    try:
        return at_once(steps, 1, root)
    finally:
        os.sched_setaffinity(0, cores)


def at_once(steps: int, number: int, root: Path) -> float:
    """Trains so many runs at once, without a sweep; returns the mean seconds from start to end."""
    folder = Path(tempfile.mkdtemp(dir=root))
    began = time.perf_counter()
    running = [
        subprocess.Popen(
            train_command(steps, seed, folder / str(seed)), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            env=environment(1),
        )
        for seed in range(number)
    ]  # fmt: skip
    seconds: dict[int, float] = {}
    while len(seconds) < number:
        for i, process in enumerate(running):
            if i not in seconds and process.poll() is not None:
                assert process.returncode == 0, process.args
                seconds[i] = time.perf_counter() - began
        time.sleep(0.01)
    return statistics.mean(seconds.values())


def steps_of(seconds: float, root: Path) -> int:
    """Returns how many steps a run of so many seconds takes, startup included."""
    at_once(1000, 1, root)  # fills the compilation cache
    few, many = 2000, 6000
    short, long = at_once(few, 1, root), at_once(many, 1, root)
    rate = (many - few) / (long - short)
    return max(round(few + rate * (seconds - short)), 1000)


def sweep(steps: int, runs: int, workers: int, root: Path, ray: str | None) -> float:
    """Returns the seconds that ``rejeu sweep`` takes."""
    plan = root / "plan.toml"
    options = "\n".join(f"{name} = {value}" for name, value in OPTIONS.items())
    settings = "\n".join(f"{name} = {json.dumps(value)}" for name, value in SETTINGS.items())
    plan.write_text(
        f"environments = ['Pendulum-v1']\nalgorithms = ['SAC']\nseeds = {runs}\nsteps = {steps}\nthreads = 1\n"
        f"no_report = true\nno_video = true\n{options}\n[settings.small]\n{settings}\n",
        encoding="utf-8",
    )
    words = ["sweep", str(plan), "--out", str(root / ("ray" if ray else "local")), "--workers", str(workers)]
    began = time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "rejeu", *words, *([] if ray is None else ["--ray", ray])],
        check=True,
        env={**os.environ, **LOOPBACK},
    )
    return time.perf_counter() - began


def process_seconds(folder: Path) -> list[float]:
    """Returns how long each run of a sweep took: from its claim to its exit status."""
    exits = sorted((folder / ".sweep").glob("*.exit"))
    return [path.stat().st_mtime - path.with_suffix(".claim").stat().st_mtime for path in exits]


def on_ray(steps: int, runs: int, workers: int, root: Path) -> float:
    """Returns the seconds of a sweep on a Ray cluster on this machine, which is started before and stopped afterwards."""
    os.environ.update(LOOPBACK)
    from ray import cluster_utils

    node = {"node_ip_address": "127.0.0.1", "include_dashboard": False, "num_cpus": workers}
    cluster = cluster_utils.Cluster(initialize_head=True, head_node_args=node)
    try:
        return sweep(steps, runs, workers, root, cluster.address)
    finally:
        cluster.shutdown()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=24)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each run")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=3, help="of the runs without a sweep")
    parser.add_argument("--only", choices=["local", "ray"])
    parser.add_argument("--out", type=Path, default=RESULT)
    arguments = parser.parse_args()
    runs, workers = arguments.runs, arguments.workers
    result: dict[str, Any] = {**provenance(), "cores": os.cpu_count()}
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        steps = steps_of(arguments.seconds, root)
        alone = [at_once(steps, 1, root) for _ in range(arguments.repeats)]
        together = [at_once(steps, workers, root) for _ in range(arguments.repeats)]
        single = [on_one_core(steps, root) for _ in range(arguments.repeats)]
        one, core, several = (statistics.median(seconds) for seconds in (alone, single, together))
        result |= {"runs": runs, "workers": workers, "steps": steps}
        result |= {"seconds_alone": alone, "seconds_on_one_core": single, "seconds_at_once": together}
        text = f"{steps:,} steps: {one:.1f} s alone, {core:.1f} s on one core, {several:.1f} s with {workers} at once"
        print(text, flush=True)
        for kind, measure in (("local", lambda: sweep(steps, runs, workers, root, None)), ("ray", None)):
            if arguments.only not in (None, kind):
                continue
            seconds = measure() if measure else on_ray(steps, runs, workers, root)
            own = process_seconds(root / kind)
            result[kind] = {
                "seconds": seconds,
                "mean_seconds_of_a_run": statistics.mean(own),
                "share_of_ideal_of_one_core": runs * core / workers / seconds,
                "share_of_ideal_of_the_whole_machine": runs * one / workers / seconds,
                "share_of_runs_at_once_without_a_sweep": runs * several / workers / seconds,
                "share_of_the_times_of_its_processes": sum(own) / workers / seconds,
            }
            print(kind, json.dumps(result[kind]), flush=True)
    write(arguments.out, result)


if __name__ == "__main__":
    main()
