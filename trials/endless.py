"""Trains in an environment whose episodes never end, with and without Ctrl-C during the last evaluation.

    python trials/endless.py

Prints what was observed, and exits with status 1 if a training did not end, lost its steps or ignored Ctrl-C.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ENVIRONMENT = """
import gymnasium as gym
import numpy as np


class Endless(gym.Env):
    observation_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.full(2, 0.5, np.float32), 1.0, False, False, {}


gym.register("Endless-v0", Endless)
"""
PATIENCE = 300.0
"""Seconds after which a process is taken for one that never ends."""


def rejeu(*words: object) -> list[str]:
    """Returns the command line of a process."""
    return [sys.executable, "-m", "rejeu", *map(str, words)]


def status(run: Path) -> dict[str, object]:
    """Returns what ``rejeu status`` says about a run."""
    done = subprocess.run(rejeu("status", run, "--json"), capture_output=True, text=True, check=False, timeout=PATIENCE)
    found: dict[str, object] = json.loads(done.stdout)
    return found


def trial(folder: Path, name: str, interrupted: bool) -> bool:
    """Trains once and returns whether it ended as it should."""
    run, began = folder / name, time.monotonic()
    words = rejeu("train", folder / "endless.py", "--steps", 200, "--out", run, "--no-report", "--no-video")
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, bufsize=1)
    assert process.stdout is not None
    lines, at = [], 0.0
    for line in process.stdout:
        lines.append(line)
        if interrupted and line.startswith("evaluating"):
            time.sleep(0.5)
            process.send_signal(signal.SIGINT)
            at = time.monotonic()
    code = process.wait(PATIENCE)
    now, found = time.monotonic(), status(run)
    print(
        f"{name}: exit status {code} after {now - began:.1f} s"
        + (f", {now - at:.1f} s after Ctrl-C" if interrupted else "")
        + f"; {found['state']}, {found['steps']} steps, model saved: {(run / 'agent.safetensors').is_file()}"
    )
    warned = any("no episode ended" in line or "cut off" in line for line in lines)
    saved = (run / "agent.safetensors").is_file() and found["steps"] == 200
    good = code == (130 if interrupted else 0) and saved and warned
    if not good:
        print("".join(lines))
    return good


def main() -> int:
    """Runs the trials; returns 1 if one failed."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "endless.py").write_text(ENVIRONMENT, encoding="utf-8")
        checked = subprocess.run(
            rejeu("check", folder / "endless.py"), capture_output=True, text=True, check=False, timeout=PATIENCE
        )
        print(f"check: {checked.stdout.strip()}")
        good = ["no episode ended" in checked.stdout, trial(folder, "whole", False), trial(folder, "stopped", True)]
        run = folder / "stopped"
        resumed = subprocess.run(
            rejeu("resume", run, "--env", folder / "endless.py", "--no-report", "--no-video"),
            capture_output=True,
            text=True,
            check=False,
            timeout=PATIENCE,
        )
        good.append(resumed.returncode == 0 and status(run)["state"] == "finished")
        print(f"resumed: exit status {resumed.returncode}, {status(run)['state']} {resumed.stderr.strip()}")
    return int(not all(good))


if __name__ == "__main__":
    sys.exit(main())
