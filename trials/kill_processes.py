"""Kills many kinds of runs at random moments, resumes each in a new process, and compares it with an uninterrupted run.

    python trials/kill_processes.py --kills 20 --only parking lunar
    python trials/kill_processes.py --kills 4

Every resumption is a new process, as with ``rejeu resume``. The runs cover large networks, many environments, EnvPool,
worker processes, training on the device, prioritized replay, n-step returns, hindsight, normalization, action masks and
parameter noise. The uninterrupted run saves no checkpoints. All weights, the buffers, the history except its times, the
state of the random generator and the best weights are compared bit for bit. A run that ends before its last kill is
compared, and the next kills are of a new one.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

RESULT = Path(__file__).parent / "results" / "kill_processes.json"
LARGE = {"policy_kwargs": {"net_arch": [256, 256]}}
SMALL = {"policy_kwargs": {"net_arch": [32, 32]}}
REPLAY = {"learning_starts": 200, "batch_size": 64, "buffer_size": 4000}


class Case(NamedTuple):
    """A configuration of a run."""

    algorithm: str
    env_id: str
    n_envs: int
    backend: str
    steps: int
    every: int
    """Environment steps between two checkpoints."""
    settings: Callable[[], dict[str, Any]]


def hindsight(**more: Any) -> dict[str, Any]:
    import rejeu

    return {"replay_buffer_class": rejeu.HerReplayBuffer, **more}


def parameter_noise() -> dict[str, Any]:
    import rejeu

    return {**SMALL, **REPLAY, "action_noise": rejeu.ParameterNoise(), "normalize": True}


CASES: dict[str, Case] = {
    "parking": Case(
        "SAC", "parking-v0", 8, "envpool", 56_000, 1000,
        lambda: hindsight(learning_rate=1e-3, gamma=0.95, batch_size=128, policy_kwargs={"net_arch": [64, 64]}),
    ),
    "lunar": Case(
        "PPO", "LunarLanderContinuous-v3", 16, "envpool", 400_000, 8000,
        lambda: {"n_steps": 256, "batch_size": 512, "n_epochs": 4, "normalize": True},
    ),
    "A2C, 64 environments, 256-256": Case("A2C", "CartPole-v1", 64, "gymnasium", 40_000, 2000, lambda: dict(LARGE)),
    "PPO, 64 environments, 256-256": Case(
        "PPO", "CartPole-v1", 64, "gymnasium", 60_000, 4000,
        lambda: {**LARGE, "n_steps": 32, "batch_size": 1024, "n_epochs": 2},
    ),
    "SAC, 256-256, batches of 512, normalized": Case(
        "SAC", "Pendulum-v1", 4, "gymnasium", 2400, 200, lambda: {**LARGE, **REPLAY, "batch_size": 512, "normalize": True}
    ),
    "DQN, priorities, 3-step": Case(
        "DQN", "CartPole-v1", 2, "gymnasium", 8000, 500, lambda: {**SMALL, **REPLAY, "priorities": {}, "n_steps": 3}
    ),
    "DDPG, noise on parameters, normalized": Case("DDPG", "Pendulum-v1", 2, "gymnasium", 8000, 500, parameter_noise),
    "SAC, hindsight, priorities, 3-step": Case(
        "SAC", "parking-v0", 4, "envpool", 8000, 500, lambda: hindsight(**SMALL, **REPLAY, priorities={}, n_steps=3)
    ),
    "SAC in worker processes": Case(
        "SAC", "Pendulum-v1", 2, "gymnasium-async", 4000, 400, lambda: {**SMALL, **REPLAY}
    ),
    "MaskablePPO": Case(
        "MaskablePPO", "MaskedCartPole-v0", 4, "gymnasium", 20_000, 1000,
        lambda: {**SMALL, "n_steps": 64, "batch_size": 64},
    ),
    "PQN on the device": Case("PQN", "jax/CartPole-v1", 16, "jax", 300_000, 10_000, lambda: dict(SMALL)),
    "SAC on the device, hindsight": Case(
        "SAC", "jax/Parking-v0", 8, "jax", 16_000, 800, lambda: hindsight(**SMALL, **REPLAY)
    ),
    "DQN on the device, priorities, 3-step": Case(
        "DQN", "jax/CartPole-v1", 4, "jax", 40_000, 2000, lambda: {**SMALL, **REPLAY, "priorities": {}, "n_steps": 3}
    ),
    "RecurrentPPO": Case(
        "RecurrentPPO", "rejeu/CartPoleNoVelocity-v0", 4, "gymnasium", 20_000, 1000,
        lambda: {**SMALL, "n_steps": 64, "batch_size": 64},
    ),
}  # fmt: skip


def masked_cart_pole() -> Any:
    """Returns CartPole without the pushes that lead out of the middle."""
    import gymnasium as gym

    class Masked(gym.Wrapper):
        def action_masks(self) -> list[bool]:
            position = self.unwrapped.state[0]
            return [position > -0.5, position < 0.5]

        def get_wrapper_state(self) -> dict[str, Any]:
            return {}

        def set_wrapper_state(self, state: dict[str, Any]) -> None:
            pass

    return Masked(gym.make("CartPole-v1"))


def vector(case: Case) -> Any:
    import gymnasium as gym

    import rejeu

    gym.register("MaskedCartPole-v0", masked_cart_pole)
    return rejeu.make_vector(case.env_id, case.n_envs, case.backend, seed=3)


def live(name: str, folder: str, with_checkpoints: bool) -> None:
    """Trains to the end, from the newest checkpoint if there is one. Prints the first step and a final digest."""
    import rejeu
    from rejeu.callbacks import Checkpoint
    from rejeu.checkpoints.run_folder import checkpoint_files

    case = CASES[name]
    agent_class = rejeu.AGENTS[case.algorithm]
    callbacks = [Checkpoint(folder, every=case.every), say_that_it_learns()] if with_checkpoints else []
    env = vector(case)
    restore, seconds = env.restore, [0.0]

    def timed(saved: Any, obs: Any) -> list[int]:
        began = time.perf_counter()
        restored = restore(saved, obs)
        seconds[0] = time.perf_counter() - began
        return restored

    env.restore = timed
    if with_checkpoints and checkpoint_files(Path(folder)):
        agent = agent_class.resume(folder, env)
        say(resumed=agent.num_timesteps, exact=agent.resumed.exact, replay=seconds[0], trained=agent.seconds["total"])
        if agent.num_timesteps < case.steps:
            agent.learn(callback=callbacks)
    else:
        policy = "MultiInputPolicy" if "parking" in case.env_id.lower() else "MlpPolicy"
        agent = agent_class(policy, env, seed=5, **case.settings())
        say(resumed=0, exact=True, replay=0.0, trained=0.0)
        agent.learn(case.steps, callback=callbacks)
    say(digest=digest(agent), trained=agent.seconds["total"])
    env.close()


def say_that_it_learns() -> Callable[[Any, Any], None]:
    """Returns a callback that prints a line once this process has performed updates, so that everything is compiled."""
    before: list[int] = []

    def callback(agent: Any, turn: Any) -> None:
        if len(before) == 2:
            return
        before[:] = before or [agent.n_updates]
        if agent.n_updates > before[0] + 1:
            before.append(agent.n_updates)
            say(learning=agent.num_timesteps)

    return callback


def say(**message: Any) -> None:
    os.write(1, (json.dumps(message) + "\n").encode())


def digest(agent: Any) -> dict[str, str]:
    """Returns a hash of each array of a run."""
    import jax
    import numpy as np

    rows = agent.history.table()
    rows[:, 5] = 0.0  # times
    run = agent.run
    best = {} if agent.best is None else {f"best.{i}": leaf for i, leaf in enumerate(agent.best.state)}
    arrays = {
        **agent.get_parameters(),
        **{f"buffer.{key}": value for key, value in run.replay.arrays().items()},
        **{f"obs.{i}": leaf for i, leaf in enumerate(jax.tree.leaves(run.obs))},
        **{f"carry.{i}": leaf for i, leaf in enumerate(jax.tree.leaves(run.carry))},
        **best,
        "history": rows,
        "counters": np.array([agent.num_timesteps, agent.n_updates]),
        "generator": np.frombuffer(json.dumps(run.rng.bit_generator.state).encode(), np.uint8),
    }
    return {key: hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest() for key, value in arrays.items()}


def start(name: str, folder: Path, with_checkpoints: bool) -> subprocess.Popen[bytes]:
    mode = "checkpoints" if with_checkpoints else "no checkpoints"
    command = [sys.executable, __file__, "--live", name, str(folder), mode]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True)


def next_message(process: subprocess.Popen[bytes]) -> dict[str, Any]:
    """Returns the next message of a process, empty if it has ended."""
    line = process.stdout.readline()
    return json.loads(line) if line else {}


def finished(process: subprocess.Popen[bytes]) -> dict[str, Any]:
    """Returns the last message of a process."""
    last: dict[str, Any] = {}
    while message := next_message(process):
        last = message
    if process.wait() or "digest" not in last:
        raise SystemExit(f"a life ended with {process.returncode}")
    return last


class Killed(NamedTuple):
    """A run that was killed, and resumed until it ended."""

    kills: int
    lives: list[dict[str, Any]]
    """The first message of each process."""
    end: dict[str, Any]
    """The last message."""


def killed(name: str, folder: Path, max_kills: int, pause: float, rng: random.Random) -> Killed:
    """Kills a run until there were ``max_kills`` kills or it ended, and lets it end.

    Args:
        name: of the case.
        folder: of the checkpoints.
        max_kills: maximum number of kills.
        pause: maximum seconds of training before a kill.
        rng: draws the moments.
    """
    lives = []
    for kills in range(max_kills + 1):
        process = start(name, folder, with_checkpoints=True)
        lives.append(next_message(process))
        if kills == max_kills:
            break
        second = next_message(process)
        if "digest" in second:
            return Killed(kills, lives, second)
        time.sleep(rng.uniform(0.0, pause))  # a random moment during training
        if process.poll() is not None:
            break
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    return Killed(kills, lives, finished(process))


def try_case(name: str, kills: int, rng: random.Random) -> dict[str, Any]:
    case = CASES[name]
    with tempfile.TemporaryDirectory() as root:
        whole = finished(start(name, Path(root) / "none", with_checkpoints=False))
        runs: list[Killed] = []
        began = time.monotonic()
        while (done := sum(run.kills for run in runs)) < kills:
            folder = Path(root) / f"run-{len(runs)}"
            runs.append(killed(name, folder, kills - done, 1.4 * whole["trained"] / kills, rng))
        lives = [life for run in runs for life in run.lives]
        resumed = [life for life in lives if life["resumed"]]
        keys = sorted({key for run in runs for key in (*whole["digest"], *run.end["digest"])})
        different = [key for key in keys if any(whole["digest"].get(key) != run.end["digest"].get(key) for run in runs)]
        return {
            "case": name,
            **{key: getattr(case, key) for key in ("algorithm", "env_id", "n_envs", "backend", "steps", "every")},
            "kills": done,
            "runs": len(runs),
            "resumed_after_step_0": len(resumed),
            "all_exact": all(life["exact"] for life in lives),
            "arrays": len(whole["digest"]),
            "arrays_that_differ": different,
            "equal": not different,
            "seconds_of_training_without_kills": round(whole["trained"], 1),
            "seconds_of_replaying": [round(life["replay"], 2) for life in resumed],
            "seconds_trained_when_resumed": [round(life["trained"], 1) for life in resumed],
            "seconds_in_all": round(time.monotonic() - began, 1),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", choices=CASES, help="cases to try, instead of all")
    parser.add_argument("--out", type=Path, default=RESULT)
    parser.add_argument("--live", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.live:
        name, folder, mode = arguments.live
        live(name, folder, mode == "checkpoints")
        return
    from provenance import commit, read, write

    tried = commit()  # at the start: the sources may change while it runs
    results = read(arguments.out)
    for name in arguments.only or CASES:
        result = try_case(name, arguments.kills, random.Random(f"{arguments.seed} {name}"))
        only = f' --only "{name}"'
        results[name] = {
            "command": f"python trials/kill_processes.py --kills {arguments.kills}{only}",
            "commit": tried,
        }
        results[name] |= {"date": time.strftime("%Y-%m-%d"), **result}
        print(json.dumps(results[name]), flush=True)
        write(arguments.out, results)


if __name__ == "__main__":
    main()
