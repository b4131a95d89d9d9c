"""Records run folders, a sweep, a study and a population for ``tests/test_older_files.py``.

    python tests/data/record.py FOLDER

Run it with the code whose files are to be kept. Networks, buffers and runs are as small as possible; what is made again
(pictures, pages) is left out. Training that is to be resumed is paused, interrupted by SIGINT, or killed by SIGKILL when a
file appears. No file contains a path of this machine, because the commands run in the folder itself.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

QUIET = ("--no-report", "--no-video", "--seed", "3", "--evaluate-episodes", "2")
NARROW = ("--set", "policy_kwargs.net_arch=[8]")
OFF_POLICY = (*NARROW, "batch_size=8", "buffer_size=150", "learning_starts=20")
HINDSIGHT = (*OFF_POLICY, "replay_buffer_class=HerReplayBuffer")
ON_POLICY = (*NARROW, "n_steps=16", "batch_size=16", "n_epochs=2")
RUN = (*QUIET, "--evaluate-every", "100", "--checkpoint-minutes", "0.02")
PLAN = """environments = ["CartPole-v1"]
algorithms = ["PPO"]
seeds = 3
steps = 96
backend = "gymnasium"
evaluate_every = 48
evaluate_episodes = 2
no_report = true
no_video = true
[settings.small]
n_steps = 16
batch_size = 16
n_epochs = 2
policy_kwargs.net_arch = [8]
"""
GYMNASIUM = ("--backend", "gymnasium", "--envs")
SEARCHED = ("--only", "learning_rate", "--evaluate-episodes", "2", *GYMNASIUM, "1", "--workers", "1")
COMMANDS: dict[str, tuple[str, ...]] = {
    "her": ("train", "parking-v0", "--algo", "SAC", "--steps", "300", *GYMNASIUM, "1", *RUN, *HINDSIGHT),
    "recurrent": ("train", "rejeu/CartPoleNoVelocity-v0", "--algo", "RecurrentPPO", "--steps", "256", "--pause", "160",
                  *GYMNASIUM, "2", *RUN, *ON_POLICY, "policy_kwargs.lstm_hidden_size=8"),
    "prioritized": ("train", "CartPole-v1", "--algo", "DQN", "--steps", "300", "--pause", "200", *GYMNASIUM, "2", *RUN,
                    *OFF_POLICY, "priorities={}", "n_steps=3", "normalize=true"),
    "device": ("train", "jax/PointMaze-v0", "--algo", "SAC", "--steps", "300", "--pause", "200", "--envs", "2", *RUN,
               *HINDSIGHT),
    "killed": ("train", "Pendulum-v1", "--algo", "TD3", "--steps", "100000", *GYMNASIUM, "1", *RUN, *OFF_POLICY),
    "seeds": ("train", "jax/CartPole-v1", "--algo", "PPO", "--steps", "100000", "--envs", "2", "--seeds", "2", *RUN,
              *ON_POLICY),
    "sweep": ("sweep", "plan.toml", "--workers", "1"),
    "study": ("tune", "CartPole-v1", "--algo", "PPO", "--trials", "3", "--steps", "96", "--final-seeds", "0",
              *SEARCHED, *ON_POLICY),
    "compared": ("tune", "CartPole-v1", "--algo", "PPO", "--trials", "4", "--steps", "96", "--final-seeds", "3",
                 *SEARCHED, *ON_POLICY),
    "population": ("pbt", "Pendulum-v1", "--algo", "SAC", "--members", "2", "--rounds", "3", "--round-steps", "60",
                   *SEARCHED, *OFF_POLICY),
}  # fmt: skip
STOPPED = {
    "killed": (signal.SIGKILL, "checkpoints/run_*[1-9]?.safetensors"),
    "sweep": (signal.SIGINT, "*1/agent.safetensors"),
    "seeds": (signal.SIGINT, "*/checkpoints/run_*[1-9]?.safetensors"),
    "study": (signal.SIGINT, "trials/0001/*/agent.safetensors"),
    "population": (signal.SIGINT, "history.csv"),
}
"""By folder: the signal, and the files in it at whose appearance it is sent."""
MADE_AGAIN = ("*.png", "*.html", "*.mp4", "*.lock", "lock")


def run(name: str, words: tuple[str, ...]) -> None:
    """Runs a command, and stops it where ``STOPPED`` says so."""
    process = subprocess.Popen([sys.executable, "-m", "rejeu", *words, "--out", name], stdin=subprocess.DEVNULL)
    number, files = STOPPED.get(name, (None, ""))
    while process.poll() is None:
        time.sleep(0.02)
        if number is not None and any(Path(name).glob(files)):
            os.kill(process.pid, number)
            number = None


def main() -> None:
    """Records what is missing in the folder and prints the sizes."""
    folder = Path(sys.argv[1])
    folder.mkdir(exist_ok=True)
    os.chdir(folder)
    Path("plan.toml").write_text(PLAN)
    for name, words in COMMANDS.items():
        if not Path(name).exists():
            run(name, words)
    for pattern in MADE_AGAIN:
        for path in Path().rglob(pattern):
            path.unlink()
    for name in COMMANDS:
        files = [path for path in Path(name).rglob("*") if path.is_file()]
        print(f"{name}: {len(files)} files, {sum(path.stat().st_size for path in files):,} bytes")
    print(
        sorted(
            {
                line
                for path in Path().rglob("*")
                if path.is_file()
                for line in path.read_bytes().splitlines()
                if b"/tmp" in line or b"/home" in line or str(Path.cwd().parents[-2]).encode() in line
            }
        )
    )


if __name__ == "__main__":
    main()
