"""Simulates power failures of a training run: between any two file operations, and on a real ext4 file system.

    python trials/power_loss.py --cuts 40

Simulation: the file operations of some runs are recorded. Every state that POSIX allows after a power failure is then
created (``tests/crash_states.py``). Files have their contents at the last ``fsync`` and a part of later writes. Folders
have their names at the last ``fsync`` of the folder and any subset of later changes. From each state the run must
resume, at most one interval older. For comparison, calls of ``fsync`` on files or on folders are removed from the
record. Runs must then be lost, otherwise the simulation cannot detect errors.

Real file system (as root on Linux): SAC trains on the ball on an ext4 file system in a file, in its own process, with a
checkpoint every 100 steps. At random moments, in two of three cases while a file is being written, the file system is
shut down as by a power failure (``EXT4_IOC_SHUTDOWN`` without flushing the journal). All data that was not on disk is
lost. The file system is mounted again and the run is resumed. At the end the run is compared, bit for bit, with an
uninterrupted run. For comparison, everything is repeated without ``fsync``.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import random
import struct
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import kill
from provenance import provenance, write

RESULT = Path(__file__).parent / "results" / "power_loss.json"
SHUTDOWN, WITHOUT_FLUSHING = 0x8004587D, 2
"""The ioctl request that shuts down an ext4 file system, and its flag."""
OFF: dict[str, Any] = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 20, "batch_size": 8, "seed": 3}
ON: dict[str, Any] = {"policy_kwargs": {"net_arch": [8]}, "n_steps": 16, "batch_size": 16, "seed": 3}
RUNS: dict[str, tuple[str, int, dict[str, Any]]] = {
    "SAC, one checkpoint kept": ("SAC", 1, {**OFF, "buffer_size": 25}),
    "SAC, two kept": ("SAC", 2, {**OFF, "buffer_size": 25}),
    "TD3 with priorities, three kept": ("TD3", 3, {**OFF, "buffer_size": 60, "priorities": {}}),
    "PPO, two kept": ("PPO", 2, ON),
}
WITHOUT = {"": (), "without fsync of files": ("sync",), "without fsync of folders": ("sync folder",)}


def on_paper(root: Path) -> dict[str, Any]:
    """Checks every state of every run; returns totals."""
    import rejeu
    from tests.crash_states import crash_states
    from tests.io.test_power_loss import EVERY, is_loss, outcome, recorded
    from tests.sharing import shared_learners

    found: dict[str, Any] = {"interval": EVERY}
    for name, (kind, keep, settings) in RUNS.items():
        with shared_learners():
            agent = rejeu.AGENTS[kind]("MlpPolicy", "rejeu/Ball-v0", **settings)
            operations = recorded(root / "recorded" / name, agent, keep, steps=65)
            one = found[name] = {"operations": len(operations)}
            for title, ignored in WITHOUT.items():
                states = [state for state in crash_states(operations, ignored) if state.n_done]
                if ignored:
                    states = random.Random(0).sample(states, min(len(states), 200))
                outcomes = []
                for i, state in enumerate(states):
                    with tempfile.TemporaryDirectory(dir=root) as folder:
                        outcomes.append(outcome(state, Path(folder), rejeu.AGENTS[kind]))
                    if i % 100 == 0:
                        print(name, title, i, "of", len(states), flush=True)
                counts = {"states": len(states), "lost": sum(map(is_loss, outcomes))}
                one |= {title: counts} if ignored else counts
                if not ignored:
                    one["most steps lost"] = max((n for n in outcomes if isinstance(n, int)), default=-1)
        print(name, json.dumps(one), flush=True)
    return found


@contextmanager
def mounted(image: Path, folder: Path) -> Iterator[None]:
    """Context in which the file system in a file is mounted. Renames do not write data to disk without fsync."""
    subprocess.run(["mount", "-o", "loop,noauto_da_alloc", str(image), str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def cut_power(folder: Path) -> None:
    """Shuts down the file system of a folder. Data that is not on disk is lost."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.ioctl(handle, SHUTDOWN, struct.pack("I", WITHOUT_FLUSHING))
    finally:
        os.close(handle)


def for_real(cuts: int, root: Path, rng: random.Random, fsync: bool) -> dict[str, Any]:
    """Simulates many power failures of a run; returns totals."""
    import numpy as np

    import rejeu

    image, disk = root / "disk.img", root / "disk"
    disk.mkdir(exist_ok=True)
    image.unlink(missing_ok=True)
    with image.open("wb") as file:
        file.truncate(256 * 2**20)
    subprocess.run(["mkfs.ext4", "-q", "-F", str(image)], check=True)
    run, lost, unreadable, writing = disk / "runs" / "ball", [], 0, 0
    command = [sys.executable, __file__, "--live", str(run), "fsync" if fsync else "no fsync"]
    for k in range(cuts):
        with mounted(image, disk):
            said = wait_until_it_learns(life := kill.Life(command), k, rng)
            writing += k % 3 != 0 and kill.wait_for_a_write(run, 10.0)
            said = max(said, life.listen())
            cut_power(disk)
            life.kill()
        with mounted(image, disk):
            try:
                step = rejeu.SAC.resume(run).num_timesteps
                lost.append(said - step)
                print(f"cut {k}: said {said}, checkpoint {step}", flush=True)
            except (rejeu.CheckpointError, FileNotFoundError, AttributeError) as error:
                unreadable += 1
                print(f"cut {k}: {error}", flush=True)
                subprocess.run(["rm", "-rf", str(run)], check=True)
    found = {
        "cuts": cuts,
        "while_a_file_was_written": writing,
        "interval": kill.EVERY,
        "runs_that_could_not_be_resumed": unreadable,
        "cuts_that_cost_more_than_an_interval": sum(n > kill.EVERY for n in lost),
        "most_steps_lost": max(lost, default=-1),
    }
    if fsync:
        with mounted(image, disk):
            agent = rejeu.SAC.resume(run)
        whole = kill.make().learn(10**9, lambda agent, turn: turn.step < step)
        one, two = agent.get_parameters(), whole.get_parameters()
        equal = agent.num_timesteps == whole.num_timesteps and all(np.array_equal(one[key], two[key]) for key in two)
        found |= {"steps_in_all": step, "equal_to_a_run_without_cuts": bool(equal)}
    return found


def wait_until_it_learns(life: kill.Life, k: int, rng: random.Random) -> int:
    """Waits until a process has taken one interval of steps and some more; returns the last step that it printed."""
    first = None
    while first is None or life.said < first + kill.EVERY:
        if life.process.poll() is not None:
            raise SystemExit(f"the run could not be resumed after {k} cuts")
        time.sleep(0.01)
        life.listen()
        first = life.said if first is None and life.said >= 0 else first
    time.sleep(rng.uniform(0, 1.0))
    return life.listen()


def live(folder: str, fsync: str) -> None:
    """Trains from the newest checkpoint, with or without ``fsync``."""
    if fsync == "no fsync":
        os.fsync = lambda handle: None
    warnings.simplefilter("ignore", UserWarning)
    kill.live(folder, 10**9)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cuts", type=int, default=40)
    parser.add_argument("--cuts-without-fsync", type=int, default=10)
    parser.add_argument("--live", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.live:
        live(*arguments.live)
        return
    warnings.simplefilter("ignore", UserWarning)
    result: dict[str, Any] = dict(provenance())
    with tempfile.TemporaryDirectory() as root:
        result["on paper"] = on_paper(Path(root))
        if arguments.cuts and os.name == "posix" and os.geteuid() == 0:
            rng = random.Random(0)
            result["ext4"] = for_real(arguments.cuts, Path(root), rng, fsync=True)
            result["ext4 without fsync"] = for_real(arguments.cuts_without_fsync, Path(root), rng, fsync=False)
    write(RESULT, result)
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
