"""The list of measurements: libraries, settings and order."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

CASES = ("limits", "parking", "steps", "rollouts", "memory", "startup")
LIBRARIES = ("rejeu", "sb3", "sbx")
ONE, ALL = "1 thread", "all threads"
VARIANTS: dict[str, dict[str, str]] = {
    "": {},
    ALL: {},
    ONE: dict.fromkeys(
        ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NPROC"), "1"
    ),
}
"""Environment variables, by their names in the report. ``NPROC`` sets the size of XLA's thread pool."""

PARKING = {
    "replay_buffer_kwargs": {"n_sampled_goal": 4, "goal_selection_strategy": "future"},
    "learning_starts": 1000,
    "buffer_size": 50_000,
    "batch_size": 64,
    "policy_kwargs": {"net_arch": [64, 64]},
    "train_freq": 1,
    "gradient_steps": 1,
}
"""Hyperparameters of the parking task. All others are the defaults, which are equal in all libraries."""
SMALL = {"batch_size": 64, "policy_kwargs": {"net_arch": [64, 64]}}
MIDDLE = {"batch_size": 128, "policy_kwargs": {"net_arch": [128, 128]}}
LARGE = {"batch_size": 256, "policy_kwargs": {"net_arch": [256, 256]}}
VALUES = {
    **MIDDLE,
    "target_update_interval": 1000,
    "exploration_initial_eps": 0.05,
    "exploration_final_eps": 0.05,
    "learning_rate": 1e-4,
}
STEPS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "SAC": ("SAC", "Pendulum-v1", SMALL),
    "SAC, 256-256": ("SAC", "Pendulum-v1", LARGE),
    "DDPG": ("DDPG", "Pendulum-v1", MIDDLE),
    "TD3": ("TD3", "Pendulum-v1", MIDDLE),
    "TQC": ("TQC", "Pendulum-v1", MIDDLE),
    "CrossQ": ("CrossQ", "Pendulum-v1", MIDDLE),
    "DQN": ("DQN", "MountainCar-v0", VALUES),
    "QRDQN": ("QRDQN", "MountainCar-v0", {**VALUES, "batch_size": 32}),  # 200 by 200 quantiles per transition
}
"""Algorithm, environment and hyperparameters of each case with one environment and one update per step."""
POOL = "SAC, 8 environments"
"""The case with eight EnvPool environments and eight updates per vector step. Hyperparameters as in ``SAC``."""
LANDER = "LunarLanderContinuous-v3"
ROLLOUT = 2048
N_ENVS = (1, 4, 16, 64)
BACKENDS = ("gymnasium", "envpool")


@dataclass(frozen=True)
class Measurement:
    """One measurement, which runs once per round in its own process."""

    case: str
    name: str
    library: str
    worker: str
    """Name of a module in ``benchmarks.bench.work``."""
    arguments: dict[str, Any] = field(default_factory=dict)
    variants: tuple[str, ...] = ("",)
    """Settings to compare. The first round measures all of them, later rounds only the fastest one."""
    rounds: int | None = None
    """Number of rounds. None means all rounds of the run."""
    keeps_compiled: bool = True
    """Whether to use the compilation cache of the run. If False, everything is compiled again."""
    counts: bool = False
    """Whether the first round also counts floating-point operations."""

    @property
    def key(self) -> str:
        """Key of the measurement in the samples file."""
        return f"{self.case}/{self.name}/{self.library}"


def everything(quick: bool = False) -> list[Measurement]:
    """Returns all measurements of a round in order, with the libraries of a case next to each other.

    ``quick`` omits cases that run the same code as others and shortens the rest. Its timings are meaningless.
    """
    seconds = 0.1 if quick else 1.2
    measurements = [
        *limits(seconds),
        *parking(quick),
        *steps(seconds),
        *rollouts(seconds),
        *memory(quick),
        *(
            Measurement("startup", "processes", library, "startup", {"library": library}, rounds=2)
            for library in LIBRARIES
        ),
    ]
    if not quick:
        return measurements
    return [
        replace(m, variants=m.variants[:1])
        for m in measurements
        if m.arguments.get("n_envs", 8) in (1, 4, 8) and is_first(m)
    ]


def is_first(measurement: Measurement) -> bool:
    """Returns whether no similar case is measured before. One number of environments is enough for PPO and A2C."""
    alike = measurement.case == "rollouts" and measurement.arguments["n_envs"] != 4
    return not alike and measurement.name != "SAC, 256-256"


def env_name(env: str, n_envs: int, backend: str) -> str:
    """Returns the key of the measurement of environment steps without an agent."""
    return f"{env}, {n_envs} on {backend}"


def limits(seconds: float) -> list[Measurement]:
    envs = [("Pendulum-v1", 1, "gymnasium"), ("MountainCar-v0", 1, "gymnasium"), ("Pendulum-v1", 8, "envpool")]
    envs += [(LANDER, n, backend) for n in N_ENVS for backend in BACKENDS]
    peaks = [
        Measurement(
            "limits", f"peak, {variant}", "rejeu", "limits", {"quantity": "peak", "seconds": seconds}, (variant,)
        )
        for variant in (ONE, ALL)
    ]
    return peaks + [
        Measurement(
            "limits",
            env_name(env, n, backend),
            "rejeu",
            "limits",
            {"quantity": "env", "env": env, "n_envs": n, "backend": backend, "seconds": seconds / 3},
        )
        for env, n, backend in envs
    ]


def parking(quick: bool) -> list[Measurement]:
    settings = {**PARKING, "learning_starts": 150} if quick else PARKING
    shared = {"settings": settings, "steps": 900 if quick else 5_000, "episodes": 1 if quick else 10}

    def job(name: str, library: str, backend: str, n_envs: int, variants: tuple[str, ...] = ("",)) -> Measurement:
        arguments = {"library": library, "backend": backend, "n_envs": n_envs, **shared}
        return Measurement("parking", name, library, "parking", arguments, variants, keeps_compiled=False)

    return [
        job("highway-env", "sb3", "gymnasium", 1, (ONE, ALL)),
        job("highway-env", "rejeu", "gymnasium", 1),
        job("EnvPool, 8 environments", "rejeu", "envpool", 8),
        job("EnvPool, 16 environments", "rejeu", "envpool", 16),
    ]


def steps(seconds: float) -> list[Measurement]:
    measurements = []
    for name, (algorithm, env, settings) in STEPS.items():
        for library in LIBRARIES:
            if library == "sbx" and algorithm == "QRDQN":
                continue
            arguments = {
                "library": library,
                "algorithm": algorithm,
                "env": env,
                "settings": settings,
                "seconds": seconds,
            }
            variants = ("",) if library == "rejeu" else (ONE, ALL)
            measurements.append(
                Measurement("steps", name, library, "steps", arguments, variants, counts=library == "rejeu")
            )
    algorithm, env, settings = STEPS["SAC"]
    arguments = {"library": "rejeu", "algorithm": algorithm, "env": env, "settings": settings, "seconds": seconds}
    arguments |= {"n_envs": 8, "backend": "envpool"}
    return [*measurements, Measurement("steps", POOL, "rejeu", "steps", arguments, counts=True)]


def rollout_settings(algorithm: str, n_envs: int) -> dict[str, Any]:
    """Returns the hyperparameters, which are the same in every library."""
    shared: dict[str, Any] = {"policy_kwargs": {"net_arch": [64, 64]}}
    if algorithm == "A2C":
        return {**shared, "n_steps": 5}
    return {**shared, "n_steps": ROLLOUT // n_envs, "batch_size": 64, "n_epochs": 5}


def rollouts(seconds: float) -> list[Measurement]:
    measurements = []
    for algorithm in ("PPO", "A2C"):
        for n in N_ENVS:
            shared = {"algorithm": algorithm, "env": LANDER, "n_envs": n, "seconds": seconds}
            shared["settings"] = rollout_settings(algorithm, n)
            for backend in BACKENDS:
                arguments = {"library": "rejeu", "backend": backend, **shared}
                name = f"{algorithm}, {n} on {backend}"
                counts = backend == "gymnasium"  # the number of operations does not depend on the backend
                measurements.append(Measurement("rollouts", name, "rejeu", "rollouts", arguments, counts=counts))
            for library in ("sb3", "sbx") if algorithm == "PPO" else ("sb3",):
                arguments = {"library": library, **shared}
                name = f"{algorithm}, {n} on gymnasium"
                measurements.append(Measurement("rollouts", name, library, "rollouts", arguments, (ONE, ALL)))
    return measurements


def memory(quick: bool) -> list[Measurement]:
    n = 10_000 if quick else 1_000_000
    measurements = []
    for task in ("parking", "pendulum"):
        for library in ("rejeu", "sb3"):
            arguments = {"library": library, "task": task, "n": n}
            measurements.append(Measurement("memory", task, library, "memory", arguments, rounds=1))
    arguments = {"library": "sb3", "task": "pendulum", "n": n, "compact": True}
    return [
        *measurements,
        Measurement("memory", "pendulum, optimize_memory_usage", "sb3", "memory", arguments, rounds=1),
    ]
