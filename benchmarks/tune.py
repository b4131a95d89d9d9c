"""Tunes SAC on Pendulum-v1 and PPO on LunarLanderContinuous-v3, interrupts both studies, and records what was found.

    python benchmarks/tune.py
    python benchmarks/tune.py pendulum --trials 6 --steps 2000 --final-seeds 3 --out /tmp/tune.json

Each study is a ``rejeu tune`` command. After a third of its trials it is stopped by Ctrl-C, after two thirds it is killed, and
each time ``rejeu resume`` continues it. The result has the winner against the default on fresh seeds, the numbers of complete,
pruned and failed trials, and whether all trials that had ended before an interruption are in the end as they were. The
limits are such that a
study takes about 15 minutes on two cores: networks and batches are small, and trainings shorter than with the presets.
"""

from __future__ import annotations

import argparse
import json
import math
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import rejeu
from rejeu.experiments import study as studies
from rejeu.experiments.study import Outcome, StudyFolder

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import machine, provenance, write

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "tune.json"
ENDED = ("complete", "pruned", "failed")
STUDIES: dict[str, dict[str, Any]] = {
    "pendulum": {
        "env": "Pendulum-v1",
        "algo": "SAC",
        "steps": 20_000,
        "options": [
            "--set",
            "policy_kwargs.net_arch=[64,64]",
            "--search",
            "batch_size=[32,64,128]",
            "learning_starts=[100,500,1000]",
        ],
    },
    "lunar-lander": {
        "env": "LunarLanderContinuous-v3",
        "algo": "PPO",
        "steps": 400_000,
        "options": [
            "--set",
            "policy_kwargs.net_arch=[64,64]",
            "--search",
            "batch_size=[64,128,256]",
            "n_epochs=[1,4,10]",
            "n_steps=[128,256,512,1024]",
        ],
    },
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", nargs="*", choices=[*STUDIES, []], help="pendulum or lunar-lander; by default both")
    parser.add_argument("--trials", type=int, default=30)
    parser.add_argument("--final-seeds", type=int, default=5)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    found = []
    for name in arguments.studies or STUDIES:
        with tempfile.TemporaryDirectory() as folder:
            found.append(run(name, Path(folder) / "study", arguments))
        print(json.dumps(found[-1], indent=1), flush=True)
    cores = machine()["cores"]
    write(arguments.out, {**provenance(), "cores": cores, "rejeu": rejeu.__version__, "studies": found})


def run(name: str, folder: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    """Runs one study with two interruptions and returns what it found."""
    study = STUDIES[name]
    words = ["tune", study["env"], "--algo", study["algo"], "--trials", str(arguments.trials)]
    words += ["--steps", str(arguments.steps or study["steps"]), "--final-seeds", str(arguments.final_seeds)]
    words += ["--workers", str(arguments.workers), "--checkpoint-minutes", "0.25", *study["options"]]
    began, interruptions = time.perf_counter(), []
    again = [*words, "--out", str(folder)]
    for kind, share in (("Ctrl-C", 1 / 3), ("SIGKILL", 2 / 3)):
        interruptions.append(interrupted(again, folder, kind, math.ceil(share * arguments.trials)))
        again = ["resume", str(folder), "--workers", str(arguments.workers)]
    done = subprocess.run(command(*again, "--json"), stdout=subprocess.PIPE, text=True, check=False)
    seconds = time.perf_counter() - began
    result = json.loads(done.stdout)
    final = {outcome.index: outcome for outcome in ended(folder)}
    states = [outcome.state for outcome in final.values()]
    return {
        "study": name,
        "command": shlex.join(["rejeu", *words]),
        "exit_status": done.returncode,
        "minutes": round(seconds / 60, 2),
        "trials": {state: states.count(state) for state in ENDED},
        "interruptions": [
            {
                "kind": one["kind"],
                "ended_before": len(one["before"]),
                "of_them_unchanged": sum(same(outcome, final.get(outcome.index)) for outcome in one["before"]),
                "exit_status": one["exit_status"],
            }
            for one in interruptions
        ],
        "best": result["best"],
        "verdict": result["verdict"],
        "difference": result["difference"],
        "comparison": result["comparison"],
        "failed": result["failed"],
    }


def interrupted(words: list[str], folder: Path, kind: str, n: int) -> dict[str, Any]:
    """Runs a command until ``n`` trials have ended, and interrupts it."""
    process = subprocess.Popen(command(*words), stdout=subprocess.DEVNULL, process_group=0)
    while process.poll() is None and len(ended(folder)) < n:
        time.sleep(0.5)
    if kind == "Ctrl-C":
        process.send_signal(signal.SIGINT)
    else:
        process.kill()
    status = process.wait()
    return {"kind": kind, "before": ended(folder), "exit_status": status}


def ended(folder: Path) -> list[Outcome]:
    """Returns the trials that have ended."""
    if not StudyFolder(folder).plan.is_file():
        return []
    return [outcome for outcome in studies.join(StudyFolder(folder)).outcomes() if outcome.state in ENDED]


def same(one: Outcome, other: Outcome | None) -> bool:
    """Returns whether a trial is as it was."""
    return other is not None and json.dumps(vars(one), default=str) == json.dumps(vars(other), default=str)


def command(*words: str) -> list[str]:
    return [sys.executable, "-m", "rejeu", *words]


if __name__ == "__main__":
    main()
