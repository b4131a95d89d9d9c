"""Kills recordings of demonstrations at random moments, fills their disk, and reads them.

    python trials/kill_recordings.py --kills 20

Each recording is ``rejeu.demonstrations.record`` of Pendulum in a process of its own, which prints the number of complete
episodes before it begins another. ``SIGKILL`` ends it at a random moment, every fourth one while the episodes are moved into
Minari's file at the end. Every complete episode must then be read, and equal one that was played without a recording. For the
full disk, the folder is on a tmpfs of 100 KB (which takes the right to mount one): the process must play all its episodes, and
those that fit must be read.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

RESULT = Path(__file__).parent / "results" / "recording_kills.json"
EPISODES = 200


class Random:
    """Plays random actions."""

    def __init__(self, space: Any) -> None:
        self.space = space
        self.space.seed(0)

    def predict(self, obs: Any, deterministic: bool = True) -> tuple[Any, None]:
        return self.space.sample(), None


def played(folder: str | None, episodes: int = EPISODES) -> Any:
    """Plays episodes, prints the number of complete ones before each, and returns them."""
    import gymnasium as gym

    from rejeu.demonstrations import record

    class Saying(gym.Wrapper):
        n = 0

        def reset(self, **kwargs: Any) -> Any:
            if folder is not None:
                os.write(1, b"%d\n" % self.n)
            self.n += 1
            return self.env.reset(**kwargs)

    env = Saying(gym.make("Pendulum-v1"))
    recording = record(Random(env.action_space), env, episodes, folder, seed=0)
    if folder is not None:
        os.write(1, b"%d\n" % env.n)
    return recording


def start(folder: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, __file__, "--live", str(folder)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def n_equal(folder: Path, expected: Any) -> int:
    """Returns how many of the first episodes are read, and equal the expected ones; -1 if one differs."""
    import numpy as np

    from rejeu.demonstrations import read

    episodes = read(folder).episodes
    same = [
        np.array_equal(episode.observations, expected_episode.observations)
        and np.array_equal(episode.actions, expected_episode.actions)
        and np.array_equal(episode.rewards, expected_episode.rewards)
        for episode, expected_episode in zip(episodes, expected.episodes, strict=False)
    ]
    return len(same) if all(same) else -1


def kill(folder: Path, rng: random.Random, at_the_end: bool) -> tuple[int, str]:
    """Kills a recording; returns the number of its complete episodes, and the activity that the kill interrupted."""
    process = start(folder)
    assert process.stdout is not None
    process.stdout.readline()
    if at_the_end:
        while process.poll() is None and not [*folder.rglob(".main_data.hdf5.*.tmp")]:
            time.sleep(0.0005)
        time.sleep(rng.uniform(0, 0.3))
    else:
        time.sleep(rng.uniform(0.02, 2.0))
    process.send_signal(signal.SIGKILL)
    numbers = process.communicate()[0].split()
    doing = "an episode"
    if [*folder.rglob(".*.tmp")]:
        doing = "a write"
    if [*folder.rglob(".main_data.hdf5.*.tmp")] or [*folder.rglob("main_data.hdf5")]:
        doing = "the end"
    return int(numbers[-1]) if numbers else 0, doing


def killed(kills: int, rng: random.Random, expected: Any) -> dict[str, Any]:
    result: dict[str, Any] = {"kills": kills, "during": {}, "episodes_complete": 0, "episodes_lost": 0, "unreadable": 0}
    for i in range(kills):
        with tempfile.TemporaryDirectory() as root:
            n, doing = kill(Path(root) / "shown", rng, i % 4 == 3)
            try:
                n_read = n_equal(Path(root) / "shown", expected) if n else 0
            except ValueError as error:
                print(error)
                n_read = -1
        result["during"][doing] = result["during"].get(doing, 0) + 1
        result["episodes_complete"] += n
        result["episodes_lost"] += max(n - max(n_read, 0), 0)
        result["unreadable"] += n_read < 0
        print(f"kill {i}: {n} episodes complete, {n_read} read and equal, during {doing}", flush=True)
    return result


def full_disk(expected: Any) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as root:
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=100k", "tmpfs", root], check=True)
        try:
            process = start(Path(root) / "shown")
            output, errors = process.communicate()
            folder = Path(root) / "shown"
            return {
                "bytes": 100 * 1024,
                "status": process.returncode,
                "episodes_played": int(output.split()[-1]),
                "episodes_written": len([*folder.rglob("episode_*.hdf5")]),
                "episodes_read_and_equal": n_equal(folder, expected),
                "warnings": errors.count(b"Warning:"),
            }
        finally:
            subprocess.run(["umount", root], check=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--live", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.live:
        played(arguments.live)
        return
    from provenance import provenance, write

    warnings.simplefilter("ignore")
    expected, rng = played(None), random.Random(arguments.seed)
    result = {**provenance(), **killed(arguments.kills, rng, expected), "full_disk": full_disk(expected)}
    write(RESULT, result)
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
