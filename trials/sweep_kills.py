"""Kills runs, Ray workers, Ray nodes and commands with many runs at random moments, and compares the models.

    python trials/sweep_kills.py --kills 30 --only sweep ray
    python trials/sweep_kills.py --kills 20 --only seeds tune --out trials/results/experiment_kills.json

A sweep has eight runs: SAC on Pendulum, DQN and PPO on CartPole. ``--seeds`` has four of DQN on CartPole. A study has
three trials of PPO on CartPole and compares its winner with the default on five seeds. An undisturbed one is trained
once, two runs at a time. Then others are disturbed until there were as many kills as asked for, those on Ray on a
cluster of a head and two nodes on this machine. Every
kill is a SIGKILL at a random moment: of a run; of the command that began them, after which ``rejeu resume`` continues;
of a Ray worker, or of everything that belongs to a node, in whose place a new one begins.

Before each kill of a run the training time since its newest checkpoint is noted, which is what it loses. The others let
their runs stop with a checkpoint. All arrays of the final models are compared bit for bit, and at the end no process
may be left.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

RESULT = Path(__file__).parent / "results" / "sweep_kills.json"
LOOPBACK = {"node_ip_address": "127.0.0.1", "include_dashboard": False}
ENVIRON = {**os.environ, "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_USAGE_STATS_ENABLED": "0"}
PAUSE = (4.0, 16.0)
"""Seconds between two kills: a process takes several to start, and a run that is lost five times in a row has failed."""
PLAN = """\
seeds = 2
threads = 1
steps = {steps}
checkpoint_minutes = {minutes}
evaluate_every = 1000000
evaluate_episodes = 2
no_report = true
no_video = true

[environments.Pendulum-v1]
algorithms = ["SAC"]

[environments.CartPole-v1]
algorithms = ["DQN", "PPO"]

[settings.a]
policy_kwargs.net_arch = [32, 32]

[settings.b]
algorithms = ["SAC"]
policy_kwargs.net_arch = [16, 16]
"""
QUIET = ["--checkpoint-minutes", "{minutes}", "--evaluate-episodes", "2"]
SMALL = ["--set", "policy_kwargs.net_arch=[32,32]"]
COMMANDS = {
    "sweep": ["sweep", "{plan}"],
    "ray": ["sweep", "{plan}"],
    "seeds": [
        *["train", "CartPole-v1", "--algo", "DQN", "--seeds", "4", "--seed", "0", "--steps", "{steps}"],
        *["--evaluate-every", "1000000", "--no-report", "--no-video", *QUIET, *SMALL],
    ],
    "tune": [
        *["tune", "CartPole-v1", "--algo", "PPO", "--trials", "3", "--steps", "{steps}", "--pruner", "none"],
        *["--backend", "gymnasium", "--only", "learning_rate", "gamma", *QUIET, *SMALL],
    ],
}
"""The command line of each kind, without the folder and the number of workers."""


class Cluster:
    """A Ray cluster of a head that runs nothing and two nodes with one CPU each. Mutable."""

    def __init__(self) -> None:
        from ray import cluster_utils

        self.cluster = cluster_utils.Cluster(initialize_head=True, head_node_args={**LOOPBACK, "num_cpus": 0})
        self.nodes = [self.cluster.add_node(**LOOPBACK, num_cpus=1) for _ in range(2)]

    def replace_a_node(self, rng: random.Random) -> None:
        node = self.nodes.pop(rng.randrange(2))
        self.cluster.remove_node(node, allow_graceful=False)
        self.nodes.append(self.cluster.add_node(**LOOPBACK, num_cpus=1))


@contextlib.contextmanager
def no_cluster() -> Iterator[None]:
    yield


@contextlib.contextmanager
def new_cluster() -> Iterator[Cluster]:
    os.environ.update({key: ENVIRON[key] for key in ("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "RAY_USAGE_STATS_ENABLED")})
    cluster = Cluster()
    try:
        yield cluster
    finally:
        cluster.cluster.shutdown()


def start(words: list[str], log: Path) -> subprocess.Popen[bytes]:
    with log.open("ab") as file:
        return subprocess.Popen([sys.executable, "-m", "rejeu", *words], stdout=file, stderr=file, env=ENVIRON)


def processes(folder: Path) -> list[tuple[int, int, str]]:
    """Returns id, parent and run of the processes that train in a folder."""
    listing = subprocess.run(["ps", "-eo", "pid=,ppid=,args="], capture_output=True, text=True, check=True).stdout
    rows = [line.split(None, 2) for line in listing.splitlines()]
    rows = [row for row in rows if len(row) == 3 and "-m rejeu" in row[2] and f"{folder}/" in row[2]]
    runs = [(int(pid), int(parent), run_of(args.rpartition(f"{folder}/")[2].split()[0])) for pid, parent, args in rows]
    return [row for row in runs if (folder / f"{row[2]}.log").is_file()]


def run_of(task: str) -> str:
    """Returns the run folder to which the file of a task belongs."""
    return task.removesuffix(".task").replace(".sweep/", "")


def seconds_since_checkpoint(run: Path) -> float | None:
    """Returns the training time of the present process since the newest checkpoint; None if it does not train."""
    folder = run / "checkpoints"
    with contextlib.suppress(FileNotFoundError):
        began = (folder / "lock").stat().st_mtime  # touched when training begins
        model = run / "agent.safetensors"
        if model.is_file() and model.stat().st_mtime >= began:  # written when training ends
            return None
        times = [path.stat().st_mtime for path in folder.glob("run_*.safetensors")]
        if times:
            return time.time() - max(*times, began)
    return None


def kill(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def disturb(
    sweep: subprocess.Popen[bytes], folder: Path, cluster: Cluster | None, rng: random.Random
) -> tuple[str, float | None] | None:
    """Kills a process; returns the victim, and the seconds of training that it costs its run. None if nothing trains."""
    running = processes(folder)
    if not running or sweep.poll() is not None:
        return None
    pid, parent, name = rng.choice(running)
    weights = {"run": 4, "worker": 3, "node": 2} if cluster else {"run": 4, "sweep": 1}
    victim = rng.choices([*weights], [*weights.values()])[0]
    lost = seconds_since_checkpoint(folder / name)
    if victim == "run":
        kill(pid)
        return victim, lost
    if victim == "sweep":
        kill(sweep.pid)
        sweep.wait()
    elif victim == "worker":
        kill(parent)
    elif cluster is not None:
        cluster.replace_a_node(rng)
    return victim, None


def wait_for_end(folder: Path, seconds: float = 120.0) -> float:
    """Waits until no process trains in a folder, and returns how long that took; infinite if it takes too long."""
    began = time.monotonic()
    while processes(folder):
        if time.monotonic() - began > seconds:
            return float("inf")
        time.sleep(0.1)
    return time.monotonic() - began


def models(folder: Path) -> dict[str, Any]:
    from safetensors.numpy import load_file

    paths = sorted(folder.rglob("agent.safetensors"))
    return {str(path.parent.relative_to(folder)): load_file(path) for path in paths}


def differing(expected: dict[str, Any], actual: dict[str, Any]) -> list[str]:
    """Returns the names of the models whose arrays are not the same bits."""

    def bits(arrays: dict[str, Any]) -> dict[str, tuple[Any, ...]]:
        return {key: (array.dtype, array.shape, array.tobytes()) for key, array in arrays.items()}

    names = expected.keys() | actual.keys()
    return sorted(
        name
        for name in names
        if name not in expected or name not in actual or bits(expected[name]) != bits(actual[name])
    )


def trial(
    command_name: str,
    words: list[str],
    kills: int,
    pause: tuple[float, float],
    undisturbed: dict[str, Any],
    root: Path,
    cluster: Cluster | None,
    rng: random.Random,
) -> dict[str, Any]:
    """Disturbs a command again and again until there were so many kills."""
    counts: Counter[str] = Counter()
    lost: list[float] = []
    ends: list[float] = []
    different: list[str] = []
    failed = rounds = 0
    options = ["--workers", "2"] + (["--ray", cluster.cluster.address] if cluster else [])
    at_once = ["--jobs", "2"] if command_name == "seeds" else options
    while counts.total() < kills:
        rounds += 1
        folder, log = root / f"{command_name}-{rounds}", root / "printed.log"
        sweep = start([*words, "--out", str(folder), *at_once], log)
        while sweep.poll() is None:
            time.sleep(rng.uniform(*pause))
            done = disturb(sweep, folder, cluster, rng) if counts.total() < kills else None
            if done is None:
                continue
            victim, seconds = done
            counts[victim] += 1
            lost += [] if seconds is None else [seconds]
            print(
                f"{command_name}, kill {counts.total()}: {victim}"
                + (f", {seconds:.2f} s lost" if seconds is not None else ""),
                flush=True,
            )
            if victim == "sweep":
                ends.append(wait_for_end(folder))
                sweep = start(["resume", str(folder), *options], log)
        failed += sweep.returncode != 0
        ends.append(wait_for_end(folder))
        different += [f"{folder.name}/{name}" for name in differing(undisturbed, models(folder))]
    if failed:
        print((root / "printed.log").read_text(encoding="utf-8"))
    return {
        "kills": counts.total(),
        **{f"kills_of_a_{victim}": number for victim, number in sorted(counts.items())},
        "sweeps": rounds,
        "sweeps_that_failed": failed,
        "runs": rounds * len(undisturbed),
        "most_seconds_of_training_lost": round(max(lost, default=0.0), 2),
        "models_that_differ": different,
        "most_seconds_until_no_process_was_left": round(max(ends), 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=30, help="of each kind of sweep")
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--checkpoint-seconds", type=float, default=3.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", choices=COMMANDS, default=["sweep", "ray"])
    parser.add_argument("--pause", type=float, nargs=2, default=PAUSE, help="least and most seconds between two kills")
    parser.add_argument("--out", type=Path, default=RESULT)
    arguments = parser.parse_args()
    from provenance import provenance, write

    rng = random.Random(arguments.seed)
    result: dict[str, Any] = {**provenance(), "checkpoint_interval_seconds": arguments.checkpoint_seconds}
    minutes = str(round(arguments.checkpoint_seconds / 60, 4))
    with tempfile.TemporaryDirectory() as name:
        root = Path(name).resolve()
        plan = root / "plan.toml"
        plan.write_text(PLAN.format(steps=arguments.steps, minutes=minutes), encoding="utf-8")
        values = {"plan": plan, "minutes": minutes, "steps": arguments.steps}
        for command_name in arguments.only:
            words = [word.format(**values) for word in COMMANDS[command_name]]
            began, undisturbed = time.monotonic(), root / f"{command_name}-undisturbed"
            at_once = ["--jobs" if command_name == "seeds" else "--workers", "2"]
            command = start([*words, "--out", str(undisturbed), *at_once], root / "printed.log")
            if command.wait() != 0:
                raise SystemExit((root / "printed.log").read_text(encoding="utf-8"))
            expected = models(undisturbed)
            print(f"{command_name}: {len(expected)} runs took {time.monotonic() - began:.0f} s undisturbed", flush=True)
            with new_cluster() if command_name == "ray" else no_cluster() as cluster:
                kills = trial(command_name, words, arguments.kills, arguments.pause, expected, root, cluster, rng)
            result["local" if command_name == "sweep" else command_name] = kills
            print(json.dumps(kills, indent=1), flush=True)
            write(arguments.out, result)


if __name__ == "__main__":
    main()
