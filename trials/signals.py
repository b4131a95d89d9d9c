"""Sends Ctrl-C, SIGTERM and SIGHUP to ``rejeu train`` at random moments and checks the state that it leaves behind.

    python trials/signals.py --signals 48

The run is SAC on ``rejeu/Ball-v0``: imports, compilation, training with evaluations and checkpoints, the last
evaluation, the learning curve and the video. Its duration is measured once without a signal. Each further run receives
a signal, or two in succession, at a random moment. The exit status must then be 130, 143 or 129.
Standard error must contain at most one line and no traceback. Both models in the folder must load. If there is a
checkpoint, the run must resume and train.

A signal that arrives before Python imports rejeu is handled by Python. Such runs are counted separately (Linux
reports whether the handler is installed).
"""

from __future__ import annotations

import argparse
import collections
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

RESULT = Path(__file__).parent / "results" / "signals.json"
SETTINGS = ["policy_kwargs.net_arch=[32,32]", "batch_size=32", "buffer_size=5000", "learning_starts=50"]
TRAIN = [
    "train",
    "rejeu/Ball-v0",
    "--algo",
    "SAC",
    "--steps",
    "3000",
    "--envs",
    "1",
    "--seed",
    "0",
    "--evaluate-every",
    "1000",
]
TRAIN += ["--evaluate-every", "1000", "--evaluate-episodes", "5", "--checkpoint-minutes", "0.01"]
STATUS = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}
PHASES = ("before rejeu", "imports and compiling", "training", "evaluation, curve and video")


def start(root: Path, number: int) -> tuple[subprocess.Popen[bytes], Path]:
    """Starts a run with its output in files. Every second run uses the script ``rejeu``."""
    script = Path(sys.executable).with_name("rejeu")
    program = [str(script)] if number % 2 and script.exists() else [sys.executable, "-m", "rejeu"]
    run = root / "run"
    with (root / "out").open("wb") as out, (root / "err").open("wb") as err:
        command = [*program, *TRAIN, "--out", str(run), "--set", *SETTINGS]
        return subprocess.Popen(command, stdout=out, stderr=err), run


def handles(process: subprocess.Popen[bytes]) -> bool:
    """Returns whether a process handles SIGTERM, which only rejeu installs a handler for."""
    try:
        status = Path(f"/proc/{process.pid}/status").read_text(encoding="ascii")
    except OSError:
        return True
    caught = next(line for line in status.splitlines() if line.startswith("SigCgt:"))
    return bool(int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1)


def phase(root: Path, process: subprocess.Popen[bytes]) -> str:
    if not handles(process):
        return PHASES[0]
    if (root / "run" / "agent.safetensors").exists():
        return PHASES[3]
    return PHASES[2] if b"run folder" in (root / "out").read_bytes() else PHASES[1]


def attempt(number: int, seconds: float, rng: random.Random) -> dict[str, Any] | None:
    """Starts a run, sends a signal and returns the outcome; None if the run ended first."""
    sent = rng.choice([*STATUS])
    twice = rng.random() < 0.15
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        process, run = start(root, number)
        time.sleep(rng.uniform(0.0, seconds))
        if process.poll() is not None:
            return None
        when = phase(root, process)
        process.send_signal(sent)
        began = time.monotonic()
        if twice:
            time.sleep(rng.uniform(0.0, 0.3))
            process.send_signal(sent)
        status = process.wait(300)
        took = time.monotonic() - began
        said = (root / "err").read_text(encoding="utf-8").replace(folder, "FOLDER")
        out = (root / "out").read_text(encoding="utf-8")
        return {
            "signal": sent.name,
            "twice": twice,
            "phase": when,
            "status": status,
            "right_status": status == STATUS[sent],
            "seconds": round(took, 2),
            "error": said,
            "one_line": said.count("\n") <= 1 and "Traceback" not in said + out,
            "left": left_by(run),
        }


def left_by(run: Path) -> str:
    """Returns the fault of a run folder, or else ``resumed``, ``no checkpoint`` or ``no folder``."""
    import rejeu

    if not run.exists():
        return "no folder"
    try:
        for name in ("agent", "best"):
            if (run / f"{name}.safetensors").exists():
                rejeu.load(run / f"{name}.safetensors")
        if not [*run.glob("checkpoints/run_*")]:
            return "no checkpoint"
        env = rejeu.make_vector("rejeu/Ball-v0", 1, "gymnasium")
        agent = rejeu.SAC.resume(run / "checkpoints", env)
        agent.learn(20, reset_num_timesteps=False)
    except Exception as error:  # with any exception the folder is unusable
        return f"{type(error).__name__}: {error}"[:200]
    return "resumed"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--signals", type=int, default=48)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the runs would inherit that it is ignored, as under nohup
    from provenance import provenance, write

    origin = provenance()  # at the start: the sources may change while it runs
    rng = random.Random(arguments.seed)
    lengths = []
    for number in range(2):  # the first run fills the compilation cache
        with tempfile.TemporaryDirectory() as folder:
            began = time.monotonic()
            process, _ = start(Path(folder), number)
            if process.wait() != 0:
                raise SystemExit((Path(folder) / "err").read_text(encoding="utf-8"))
            lengths.append(time.monotonic() - began)
    found: list[dict[str, Any]] = []
    number = 0
    while len(found) < arguments.signals:
        number += 1
        one = attempt(number, lengths[-1], rng)
        if one is not None:
            found.append(one)
            print(len(found), json.dumps(one), flush=True)
    counted = [one for one in found if one["phase"] != PHASES[0]]
    result = {
        **origin,
        "seconds_of_a_run": round(lengths[-1], 1),
        "signals": len(found),
        "by_phase": {name: sum(one["phase"] == name for one in found) for name in PHASES},
        **{kind.name: sum(one["signal"] == kind.name for one in counted) for kind in STATUS},
        "sent_twice": sum(one["twice"] for one in counted),
        "right_status": sum(one["right_status"] for one in counted),
        "one_line_at_most": sum(one["one_line"] for one in counted),
        "left": dict(collections.Counter(one["left"] for one in counted)),
        "most_seconds_until_the_end": max(one["seconds"] for one in counted),
        "wrong": [one for one in counted if not (one["right_status"] and one["one_line"])],
        "before_rejeu": [
            {key: one[key] for key in ("signal", "status", "error")} for one in found if one["phase"] == PHASES[0]
        ],
    }
    write(RESULT, result)
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
