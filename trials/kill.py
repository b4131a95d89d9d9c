"""Kills a training run at random moments, hundreds of times, and resumes it.

    python trials/kill.py --kills 200

The run is SAC on ``rejeu/Ball-v0`` with a checkpoint every 100 environment steps. Every process resumes from the newest
checkpoint and prints each step that it takes. ``SIGKILL`` ends it at a random moment, in two of three cases as soon as
a file is being written. After every kill the folder must contain a checkpoint that loads and is at most one interval
older than the last printed step. At the end the run continues to a fixed step and is compared, bit for bit, with an
uninterrupted run.
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
from pathlib import Path

RESULT = Path(__file__).parent / "results" / "kill.json"
EVERY = 100
SETTINGS = {"policy_kwargs": {"net_arch": [32, 32]}, "batch_size": 32, "buffer_size": 5000, "learning_starts": 50}


def make() -> object:
    import rejeu

    return rejeu.SAC("MlpPolicy", "rejeu/Ball-v0", seed=7, **SETTINGS)


def live(folder: str, last: int) -> None:
    """Trains until step ``last``, from the newest checkpoint if there is one, and prints every step."""
    import rejeu
    from rejeu.callbacks import Checkpoint
    from rejeu.checkpoints.run_folder import checkpoint_files

    def say(agent: rejeu.SAC, turn: object) -> bool:
        os.write(1, b"%d\n" % agent.num_timesteps)
        return agent.num_timesteps < last

    callbacks = [say, Checkpoint(folder, every=EVERY)]
    if checkpoint_files(Path(folder)):
        agent = rejeu.SAC.resume(folder)
        if agent.num_timesteps < last:
            agent.learn(callback=callbacks)
    else:
        make().learn(10**9, callbacks)


class Life:
    """A process to kill."""

    def __init__(self, command: list[str]) -> None:
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        self.last_number = -1
        os.set_blocking(self.process.stdout.fileno(), False)
        self._rest = b""

    def listen(self) -> int:
        """Reads the output so far and returns the last number, or -1 if there is none."""
        while chunk := self._read():
            *lines, self._rest = (self._rest + chunk).split(b"\n")
            if lines:
                self.last_number = int(lines[-1])
        return self.last_number

    def _read(self) -> bytes:
        try:
            return os.read(self.process.stdout.fileno(), 65536)
        except BlockingIOError:
            return b""

    def kill(self) -> int:
        """Kills the process and returns the last number that it printed."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        last_number = self.listen()
        self.process.stdout.close()
        return last_number


def wait_for_a_write(folder: Path, seconds: float) -> bool:
    """Waits until a temporary file exists, that is, until a file is being written."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if any(name.endswith(".tmp") for name in os.listdir(folder)):
            return True
        time.sleep(0.0002)
    return False


def kill_rejeu(kills: int, rng: random.Random) -> dict[str, object]:
    import numpy as np

    import rejeu

    with tempfile.TemporaryDirectory() as root:
        folder = Path(root) / "run"
        folder.mkdir()
        lost, unreadable, during_writes, leftovers = [], 0, 0, 0
        for k in range(kills):
            life = Life([sys.executable, __file__, "--live", str(folder), str(10**9)])
            first, early = None, k % 10 == 0  # one in ten is killed during startup, before its first update
            while first is None or (not early and life.last_number < first + EVERY):
                if life.process.poll() is not None:
                    raise SystemExit(f"the run could not go on after {k} kills")
                time.sleep(0.01)
                life.listen()
                first = life.last_number if first is None and life.last_number >= 0 else first
            time.sleep(rng.uniform(0, 1.0))
            writing = k % 3 != 0 and not early and wait_for_a_write(folder, 10.0)
            if writing:
                time.sleep(rng.choice([0.0, rng.uniform(0, 0.01)]))
            printed = life.kill()
            during_writes += any(name.endswith(".tmp") for name in os.listdir(folder))
            try:
                step = rejeu.SAC.resume(folder).num_timesteps
            except (rejeu.CheckpointError, FileNotFoundError) as error:
                unreadable += 1
                print(f"kill {k}: {error}", flush=True)
                continue
            lost.append(printed - step)
            print(f"kill {k}: said {printed}, checkpoint {step}, while writing {writing}", flush=True)
        last = rejeu.SAC.resume(folder).num_timesteps + 3 * EVERY + 17
        subprocess.run(
            [sys.executable, __file__, "--live", str(folder), str(last)], check=True, stdout=subprocess.DEVNULL
        )
        agent = rejeu.SAC.resume(folder)
        whole = make().learn(10**9, lambda agent, turn: turn.step < last)
        parameters, expected_parameters = agent.get_parameters(), whole.get_parameters()
        arrays = agent.replay_buffer.arrays(), whole.replay_buffer.arrays()
        leftovers = sum(name.endswith(".tmp") for name in os.listdir(folder))
        return {
            "kills": kills,
            "while_a_file_was_written": during_writes,
            "interval": EVERY,
            "checkpoints_that_did_not_load": unreadable,
            "most_steps_lost": max(lost),
            "mean_steps_lost": float(np.mean(lost)),
            "steps_in_all": last,
            "temporary_files_left": leftovers,
            "equal_to_a_run_without_kills": bool(
                agent.num_timesteps == whole.num_timesteps == last
                and all(np.array_equal(parameters[key], expected_parameters[key]) for key in expected_parameters)
                and all(np.array_equal(arrays[0][key], arrays[1][key]) for key in arrays[1])
            ),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--live", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.live:
        live(arguments.live[0], int(arguments.live[1]))
    else:
        from provenance import provenance, write

        rng = random.Random(arguments.seed)
        result = {**provenance(), "rejeu": kill_rejeu(arguments.kills, rng)}
        write(RESULT, result)
        print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
