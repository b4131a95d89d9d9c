"""Kills a training run at random moments, hundreds of times, and resumes it. Does the same with Stable-Baselines3.

    python trials/kill.py --kills 200 --sb3-python PATH

The run is SAC on ``rejeu/Ball-v0`` with a checkpoint every 100 environment steps. Every process resumes from the newest
checkpoint and prints each step that it takes. ``SIGKILL`` ends it at a random moment, in two of three cases as soon as
a file is being written. After every kill the folder must contain a checkpoint that loads and is at most one interval
older than the last printed step. At the end the run continues to a fixed step and is compared, bit for bit, with an
uninterrupted run.

With ``--sb3-python`` (an interpreter with Stable-Baselines3 2.9.2), SAC on Pendulum is killed in two configurations.
The first uses ``CheckpointCallback`` with the replay buffer every 100 steps, where every file has a new name. The
second repeatedly saves the model and the replay buffer to the same paths. The results are the number of files that
cannot be loaded, and the number of steps since the newest files that can be loaded.
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
    from rejeu.agents.run_files import run_files
    from rejeu.callbacks import Checkpoint

    def say(agent: rejeu.SAC, turn: object) -> bool:
        os.write(1, b"%d\n" % agent.num_timesteps)
        return agent.num_timesteps < last

    callbacks = [say, Checkpoint(folder, every=EVERY)]
    if run_files(Path(folder)):
        agent = rejeu.SAC.resume(folder)
        if agent.num_timesteps < last:
            agent.learn(callback=callbacks)
    else:
        make().learn(10**9, callbacks)


def live_sb3(folder: str) -> None:
    """Saves a model and its replay buffer with Stable-Baselines3, repeatedly, to the same paths."""
    from stable_baselines3 import SAC

    model = SAC("MlpPolicy", "Pendulum-v1", seed=7, **SETTINGS)
    model.learn(300)
    for i in range(10**9):
        model.save(f"{folder}/model")
        model.save_replay_buffer(f"{folder}/replay")
        os.write(1, b"%d\n" % i)


def live_sb3_callback(folder: str) -> None:
    """Trains with Stable-Baselines3's checkpoints, which have new names, and prints every step."""
    from stable_baselines3 import SAC
    from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback

    class Say(BaseCallback):
        def _on_step(self) -> bool:
            os.write(1, b"%d\n" % self.num_timesteps)
            return True

    model = SAC("MlpPolicy", "Pendulum-v1", seed=7, **SETTINGS)
    model.learn(10**9, [CheckpointCallback(EVERY, folder, save_replay_buffer=True), Say()])


def check_sb3_callback(folder: str) -> None:
    from stable_baselines3 import SAC

    model = SAC("MlpPolicy", "Pendulum-v1", **SETTINGS)
    steps = sorted({int(path.name.split("_")[-2]) for path in Path(folder).glob("rl_model_*_steps.*")}, reverse=True)
    errors: list[str] = []
    for step in steps:
        n = len(errors)
        for what, load in (
            ("model", lambda step=step: SAC.load(f"{folder}/rl_model_{step}_steps")),
            (
                "replay_buffer",
                lambda step=step: model.load_replay_buffer(f"{folder}/rl_model_replay_buffer_{step}_steps"),
            ),
        ):
            try:
                load()
            except Exception as error:  # with any exception the file is lost
                text = f"{what}: {type(error).__name__}: {error}".replace(folder, "FOLDER")
                errors.append(text.replace(f"_{step}_", "_N_")[:100])
        if len(errors) == n:
            print(json.dumps({"step": step, "errors": errors}))
            return
    print(json.dumps({"step": None, "errors": errors}))


def check_sb3(folder: str) -> None:
    from stable_baselines3 import SAC

    said = {}
    for what in ("model", "replay"):
        try:
            if what == "model":
                model = SAC.load(f"{folder}/model")
            else:
                model = SAC("MlpPolicy", "Pendulum-v1", **SETTINGS)
                model.load_replay_buffer(f"{folder}/replay")
            said[what] = ""
        except Exception as error:  # with any exception the file is lost
            said[what] = f"{type(error).__name__}: {error}".replace(folder, "FOLDER")[:100]
    print(json.dumps(said))


class Life:
    """A process to kill."""

    def __init__(self, command: list[str]) -> None:
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        self.said = -1
        os.set_blocking(self.process.stdout.fileno(), False)
        self._rest = b""

    def listen(self) -> int:
        """Reads the output so far and returns the last number, or -1 if there is none."""
        while part := self._read():
            *lines, self._rest = (self._rest + part).split(b"\n")
            if lines:
                self.said = int(lines[-1])
        return self.said

    def _read(self) -> bytes:
        try:
            return os.read(self.process.stdout.fileno(), 65536)
        except BlockingIOError:
            return b""

    def kill(self) -> int:
        """Kills the process and returns the last number that it printed."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        said = self.listen()
        self.process.stdout.close()
        return said


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
            while first is None or (not early and life.said < first + EVERY):
                if life.process.poll() is not None:
                    raise SystemExit(f"the run could not go on after {k} kills")
                time.sleep(0.01)
                life.listen()
                first = life.said if first is None and life.said >= 0 else first
            time.sleep(rng.uniform(0, 1.0))
            writing = k % 3 != 0 and not early and wait_for_a_write(folder, 10.0)
            if writing:
                time.sleep(rng.choice([0.0, rng.uniform(0, 0.01)]))
            said = life.kill()
            during_writes += any(name.endswith(".tmp") for name in os.listdir(folder))
            try:
                step = rejeu.SAC.resume(folder).num_timesteps
            except (rejeu.CheckpointError, FileNotFoundError) as error:
                unreadable += 1
                print(f"kill {k}: {error}", flush=True)
                continue
            lost.append(said - step)
            print(f"kill {k}: said {said}, checkpoint {step}, while writing {writing}", flush=True)
        last = rejeu.SAC.resume(folder).num_timesteps + 3 * EVERY + 17
        subprocess.run(
            [sys.executable, __file__, "--live", str(folder), str(last)], check=True, stdout=subprocess.DEVNULL
        )
        agent = rejeu.SAC.resume(folder)
        whole = make().learn(10**9, lambda agent, turn: turn.step < last)
        one, two = agent.get_parameters(), whole.get_parameters()
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
                and all(np.array_equal(one[key], two[key]) for key in two)
                and all(np.array_equal(arrays[0][key], arrays[1][key]) for key in arrays[1])
            ),
        }


def kill_sb3(python: str, kills: int, rng: random.Random) -> dict[str, object]:
    lost = {"model": 0, "replay": 0}
    errors: list[str] = []
    for k in range(kills):
        with tempfile.TemporaryDirectory() as folder:
            life = Life([python, __file__, "--live-sb3", folder])
            while life.listen() < 1 and life.process.poll() is None:
                time.sleep(0.01)
            time.sleep(rng.uniform(0, 1.0))
            life.kill()
            done = subprocess.run([python, __file__, "--check-sb3", folder], capture_output=True, text=True, check=True)
            said = json.loads(done.stdout.strip().splitlines()[-1])
            print(f"Stable-Baselines3, kill {k}: {said}", flush=True)
            for what, error in said.items():
                lost[what] += bool(error)
                errors += [error] * bool(error)
    return {
        "kills": kills,
        "models_lost": lost["model"],
        "replay_buffers_lost": lost["replay"],
        "errors": sorted({*errors}),
    }


def kill_sb3_callback(python: str, kills: int, rng: random.Random) -> dict[str, object]:
    lost, unusable, nothing, errors = [], 0, 0, set()
    for k in range(kills):
        with tempfile.TemporaryDirectory() as folder:
            life = Life([python, __file__, "--live-sb3-callback", folder])
            while life.listen() < 2 * EVERY and life.process.poll() is None:
                time.sleep(0.01)
            time.sleep(rng.uniform(0, 1.0))
            if k % 3 != 0:  # as soon as a new file exists
                names = set(os.listdir(folder))
                until = time.monotonic() + 10.0
                while set(os.listdir(folder)) == names and time.monotonic() < until:
                    time.sleep(0.0002)
            said = life.kill()
            command = [python, __file__, "--check-sb3-callback", folder]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            found = json.loads(done.stdout.strip().splitlines()[-1])
            print(f"Stable-Baselines3's callback, kill {k}: said {said}, {found}", flush=True)
            unusable += bool(found["errors"])
            errors |= set(found["errors"])
            nothing += found["step"] is None
            lost += [] if found["step"] is None else [said - found["step"]]
    return {
        "kills": kills,
        "interval": EVERY,
        "newest_checkpoint_not_whole": unusable,
        "no_checkpoint_whole": nothing,
        "most_steps_lost": max(lost, default=-1),
        "errors": sorted(errors),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--sb3-kills", type=int, default=30)
    parser.add_argument("--sb3-python")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--live", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--live-sb3", help=argparse.SUPPRESS)
    parser.add_argument("--check-sb3", help=argparse.SUPPRESS)
    parser.add_argument("--live-sb3-callback", help=argparse.SUPPRESS)
    parser.add_argument("--check-sb3-callback", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.live:
        live(arguments.live[0], int(arguments.live[1]))
    elif arguments.live_sb3:
        live_sb3(arguments.live_sb3)
    elif arguments.check_sb3:
        check_sb3(arguments.check_sb3)
    elif arguments.live_sb3_callback:
        live_sb3_callback(arguments.live_sb3_callback)
    elif arguments.check_sb3_callback:
        check_sb3_callback(arguments.check_sb3_callback)
    else:
        from provenance import provenance, write

        rng = random.Random(arguments.seed)
        result: dict[str, object] = {**provenance({arguments.sb3_python: "PATH"})}
        result["rejeu"] = kill_rejeu(arguments.kills, rng)
        if arguments.sb3_python:
            result["stable_baselines3"] = kill_sb3(arguments.sb3_python, arguments.sb3_kills, rng)
            result["stable_baselines3_callback"] = kill_sb3_callback(arguments.sb3_python, arguments.sb3_kills, rng)
        write(RESULT, result)
        print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
