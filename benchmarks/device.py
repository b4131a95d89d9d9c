"""Measures training on the device against the loop of the host, and several seeds in one program against one.

    python benchmarks/device.py [--cases NAME ...] [--seconds S] [--seeds 1 2 8 64] [--envs 1 16 256]

Every measurement is a process of its own, so that compilation and the memory of one do not affect another. Steps per second
are those of whole chunks or turns in the time ``--seconds`` after the program is compiled and the replay buffer is used;
the time before is reported as ``compile_seconds`` (tracing and compiling) and ``startup_seconds``. Peers are measured in the
same run, in turn with the device. The results are written to ``benchmarks/results/device.json`` with the command, commit and
device. JAX chooses the device; ``JAX_PLATFORMS=cpu`` forces a CPU.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import in_process, machine, provenance, write

RESULT = Path(__file__).parent / "results" / "device.json"
PARKING = {
    "replay_buffer_class": "HerReplayBuffer",
    "policy_kwargs": {"net_arch": [64, 64, 64], "layer_norm": True},
    "batch_size": 128,
    "learning_rate": 1e-3,
    "gamma": 0.95,
    "learning_starts": 1_024,
    "buffer_size": 100_000,
}
"""The preset of parking-v0, with a constant learning rate."""


class Case(NamedTuple):
    """The algorithm, environments and hyperparameters of a measurement."""

    algorithm: str
    env: str
    """The environment in JAX."""
    peer: str
    """The environment of the host's loop."""
    backend: str
    """Its backend; ``"gymnasium"`` where EnvPool is not installed."""
    n_envs: int
    settings: dict[str, Any]


CASES = {
    "dqn": Case("DQN", "jax/CartPole-v1", "CartPole-v1", "gymnasium", 1, {"learning_starts": 500}),
    "dqn, every step": Case(
        "DQN", "jax/CartPole-v1", "CartPole-v1", "gymnasium", 1,
        {"learning_starts": 500, "train_freq": 1, "batch_size": 64, "policy_kwargs": {"net_arch": [64, 64]}},
    ),
    "sac": Case("SAC", "jax/Pendulum-v1", "Pendulum-v1", "gymnasium", 1, {"learning_starts": 500}),
    "sac, 64-64": Case(
        "SAC", "jax/Pendulum-v1", "Pendulum-v1", "gymnasium", 1,
        {"learning_starts": 500, "batch_size": 64, "policy_kwargs": {"net_arch": [64, 64]}},
    ),
    "ppo": Case(
        "PPO", "jax/CartPole-v1", "CartPole-v1", "envpool", 16, {"n_steps": 128, "n_epochs": 4, "batch_size": 256}
    ),
    "ppo, 4 envs": Case(
        "PPO", "jax/CartPole-v1", "CartPole-v1", "envpool", 4, {"n_steps": 128, "n_epochs": 4, "batch_size": 128}
    ),
    "parking": Case("SAC", "jax/Parking-v0", "parking-v0", "envpool", 16, PARKING),
    "parking, 1 update in 16 steps": Case(
        "SAC", "jax/Parking-v0", "parking-v0", "envpool", 16, {**PARKING, "train_freq": 16}
    ),
}  # fmt: skip
SEEDED = ("dqn, every step", "sac, 64-64", "ppo", "ppo, 4 envs", "parking")
"""Cases that are measured with several seeds."""
SCALED = ("ppo", "parking", "parking, 1 update in 16 steps")
"""Cases that are measured with several numbers of environments."""


def child(name: str, loop: str, n_envs: int, n_seeds: int, seconds: float) -> dict[str, Any]:
    """Returns one measurement; ``loop`` is ``device``, ``host`` (the peer) or ``host jax`` (the host's loop in JAX)."""
    import jax

    import rejeu
    from rejeu.agents.together import train_seeds
    from rejeu.core import xla

    case, begun = CASES[name], time.perf_counter()
    policy = "MultiInputPolicy" if "arking" in case.env else "MlpPolicy"
    algorithm = rejeu.AGENTS[case.algorithm]
    warm = {"at": 0.0, "step": 0}
    least = 4 * case.settings.get("learning_starts", case.settings.get("n_steps", 0) * n_envs)
    chunks: list[tuple[float, int]] = []

    def watch(agent: Any, progress: Any) -> bool:
        now = time.perf_counter()
        if not warm["step"] and progress.step >= least and len(chunks) >= 3:
            warm.update(at=now, step=progress.step)
        chunks.append((now, progress.step))
        return not warm["step"] or now - warm["at"] < seconds

    def follows(agent: Any, progress: Any) -> bool:
        return not warm["step"] or time.perf_counter() - warm["at"] < seconds

    if n_seeds > 1:
        train_seeds(
            algorithm,
            policy,
            case.env,
            10**9,
            seeds=n_seeds,
            n_envs=n_envs,
            callback=lambda agent: watch if agent.seed == 0 else follows,
            **case.settings,
        )
    else:
        vector = (
            rejeu.make_vector(case.peer, n_envs, case.backend)
            if loop == "host"
            else rejeu.make_vector(case.env, n_envs)
        )
        agent = algorithm(policy, vector, seed=0, **case.settings)
        agent.on_device = loop == "device"
        agent.learn(10**9, watch)
    at, step = chunks[-1]
    return {
        "steps_per_second": n_seeds * (step - warm["step"]) / (at - warm["at"]),
        "startup_seconds": warm["at"] - begun,
        "compile_seconds": xla.seconds(),
        "threads": xla.threads(),
        "device": f"{jax.devices()[0].device_kind} ({jax.default_backend()})",
    }


def measure(name: str, loop: str, n_envs: int, n_seeds: int, seconds: float) -> dict[str, Any]:
    """Returns a measurement made in a process of its own, or its error."""
    words = [sys.executable, __file__, "--child", json.dumps([name, loop, n_envs, n_seeds, seconds])]
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": ""}  # no cache, so that every process compiles
    labels = {"case": name, "kind": loop, "n_envs": n_envs, "n_seeds": n_seeds}
    return {**labels, **in_process(*words, environment=environment)}


def plan(cases: list[str], seeds: list[int], envs: list[int]) -> list[tuple[str, str, int, int]]:
    """Returns the measurements: case, loop, number of environments and of seeds."""
    measurements = []
    for name in cases:
        case = CASES[name]
        measurements += [(name, loop, case.n_envs, 1) for loop in ("device", "host", "host jax")]
        measurements += [(name, "device", case.n_envs, n) for n in seeds if n > 1 and name in SEEDED]
        measurements += [(name, "device", n, 1) for n in envs if n != case.n_envs and name in SCALED]
    return measurements


def combined(rounds: list[dict[str, Any]]) -> dict[str, Any]:
    """Returns the medians over the rounds of a measurement."""
    good = [result for result in rounds if "error" not in result]
    if not good:
        return rounds[-1]
    numbers = ("steps_per_second", "startup_seconds", "compile_seconds")
    return {**good[0], **{key: median(result[key] for result in good) for key in numbers}, "rounds": len(good)}


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", default=[*CASES], choices=[*CASES])
    parser.add_argument("--seconds", type=float, default=5.0, help="of each measurement, after the start")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 8, 64])
    parser.add_argument("--envs", nargs="+", type=int, default=[])
    parser.add_argument("--out", type=Path, default=RESULT)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child is not None:
        print(json.dumps(child(*json.loads(arguments.child))))
        return
    wanted = plan(arguments.cases, arguments.seeds, arguments.envs)
    rounds: dict[tuple[str, str, int, int], list[dict[str, Any]]] = {measurement: [] for measurement in wanted}
    for _ in range(arguments.rounds):
        for measurement in wanted:
            rounds[measurement].append(measure(*measurement, arguments.seconds))
            print(json.dumps(rounds[measurement][-1]), flush=True)
    results = [combined(repetitions) for repetitions in rounds.values()]
    content = {
        **provenance(),
        "machine": {"platform": platform.platform(), **machine()},
        "device": next((result["device"] for result in results if "device" in result), None),
        "seconds": arguments.seconds,
        "results": results,
    }
    write(arguments.out, content)


if __name__ == "__main__":
    main()
