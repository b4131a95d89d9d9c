"""Compares training in one program with Rejax, and with Stable-Baselines3, with the same settings.

    python benchmarks/device_peers.py --rejax-python PATH --sb3-python PATH
    python benchmarks/device_peers.py --cases dqn --libraries rejeu rejax --rejax-python PATH --rounds 1 --out /tmp/out.json

PPO and DQN are trained on CartPole-v1 and SAC on Pendulum-v1, with Rejax's default settings of DQN and SAC, and rollouts of
8 and 16 environments and 128 steps, four epochs and four minibatches for PPO.
``SETTINGS`` has each setting under its name in each library; ``measurements.md`` says what
remains different. rejeu and Rejax train in environments in JAX, Stable-Baselines3 in Gymnasium's.

Every measurement is a process of its own, and the libraries take turns. Steps per second are those after compilation, with a
replay buffer that is in use; the time of tracing and compiling is reported as ``compile_seconds``. The peers are measured
with one thread and with all threads in the first round, and with the faster setting from then on; rejeu chooses by itself.
Ratios are those of the rounds, and the result is their median. It is written to ``benchmarks/results/device_peers.json``.

Rejax 0.1.3 needs a version of gymnax below 1.0, so each peer has a Python of its own::

    python -m venv PEER && PEER/bin/pip install rejax==0.1.3 "gymnax<1.0"
    python -m venv PEER && PEER/bin/pip install torch==2.13.0 stable-baselines3==2.9.2
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from importlib import metadata
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import in_process, machine, provenance, write

ROOT = Path(__file__).resolve().parents[1]
RESULT = ROOT / "benchmarks" / "results" / "device_peers.json"
LIBRARIES = ("rejeu", "rejax", "sb3")
PACKAGES = {
    "rejeu": ("jax", "jaxlib", "equinox", "optax", "gymnasium"),
    "rejax": ("rejax", "gymnax", "jax", "jaxlib", "flax", "optax"),
    "sb3": ("stable-baselines3", "torch", "gymnasium"),
}
THREADS = {
    "": {},
    "all threads": {},
    "1 thread": dict.fromkeys(("NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
}
"""Environment variables of the ways to measure."""

Names = tuple[tuple[str, Any] | None, tuple[str, Any] | None, tuple[str, Any] | None]
"""A setting's name and value in rejeu, Rejax and Stable-Baselines3; None where the library has no such setting."""

NET, ACTIVATION = ("policy_kwargs.net_arch", [64, 64]), "policy_kwargs.activation_fn"


def same(name: str, value: Any) -> Names:
    """Returns a setting that has the same name and value in all libraries."""
    return (name, value), (name, value), (name, value)


OFF_POLICY: tuple[Names, ...] = (
    same("learning_rate", 3e-4),
    same("gamma", 0.99),
    same("batch_size", 256),
    same("buffer_size", 131_072),
    (("learning_starts", 2_048), ("fill_buffer", 2_048), ("learning_starts", 2_048)),
    (("train_freq", 1), None, ("train_freq", 1)),  # Rejax learns after every step of its environments
    (("gradient_steps", 1), ("num_epochs", 1), ("gradient_steps", 1)),
    (("tau", 0.01), ("polyak", 0.99), ("tau", 0.01)),
    (("target_update_interval", 1), ("target_update_freq", 1), ("target_update_interval", 1)),
)


def ppo(n_envs: int) -> tuple[Names, ...]:
    """Returns the settings of PPO with four minibatches of a rollout."""
    size = n_envs * 128 // 4
    return (
        same("learning_rate", 3e-4),
        same("gamma", 0.99),
        same("gae_lambda", 0.95),
        same("ent_coef", 0.01),
        same("vf_coef", 0.5),
        (("n_steps", 128), ("num_steps", 128), ("n_steps", 128)),
        (("n_epochs", 4), ("num_epochs", 4), ("n_epochs", 4)),
        (("batch_size", size), ("num_minibatches", 4), ("batch_size", size)),
        (("clip_range", 0.2), ("clip_eps", 0.2), ("clip_range", 0.2)),
        (("clip_range_vf", 0.2), None, ("clip_range_vf", 0.2)),  # Rejax clips values by clip_eps
        same("max_grad_norm", 0.5),
        (NET, ("agent_kwargs.hidden_layer_sizes", [64, 64]), NET),
        ((ACTIVATION, "tanh"), ("agent_kwargs.activation", "tanh"), (ACTIVATION, "Tanh")),
    )


SETTINGS: dict[str, tuple[Names, ...]] = {
    "ppo": ppo(16),
    "ppo8": ppo(8),
    "dqn": (
        *OFF_POLICY,
        (("double_q", True), ("ddqn", True), None),
        (("loss", "squared"), None, None),
        (("exploration_initial_eps", 0.05), ("eps_start", 0.05), ("exploration_initial_eps", 0.05)),
        (("exploration_final_eps", 0.05), ("eps_end", 0.05), ("exploration_final_eps", 0.05)),
        (("max_grad_norm", None), ("max_grad_norm", float("inf")), ("max_grad_norm", float("inf"))),
        (NET, None, NET),  # Rejax's network is always 64-64
        ((ACTIVATION, "silu"), ("agent_kwargs.activation", "swish"), (ACTIVATION, "SiLU")),
    ),
    "sac": (
        *OFF_POLICY,
        (("n_critics", 2), ("num_critics", 2), None),  # Stable-Baselines3's default
        (NET, ("hidden_layer_sizes", [64, 64]), NET),
        ((ACTIVATION, "relu"), ("agent_kwargs.activation", "relu"), (ACTIVATION, "ReLU")),
    ),
}
"""The settings of the cases by name. Networks of actor and critic are separate everywhere."""


class Case(NamedTuple):
    """What is trained."""

    algorithm: str
    env: str
    n_envs: int
    unit: int
    """Environment steps that are timed at once: a multiple of a rollout, and more than ``learning_starts``."""


CASES = {
    "ppo": Case("PPO", "CartPole-v1", 16, 20 * 16 * 128),
    "ppo8": Case("PPO", "CartPole-v1", 8, 40 * 8 * 128),
    "dqn": Case("DQN", "CartPole-v1", 1, 2_560),
    "sac": Case("SAC", "Pendulum-v1", 1, 2_560),
}


def settings_of(name: str, library: str) -> dict[str, Any]:
    """Returns the settings of a case in a library, as keyword arguments."""
    settings: dict[str, Any] = {}
    for found in (row[LIBRARIES.index(library)] for row in SETTINGS[name]):
        if found is not None:
            group, _, key = found[0].rpartition(".")
            (settings.setdefault(group, {}) if group else settings)[key] = found[1]
    return settings


def rejeu_speed(name: str, seconds: float) -> dict[str, Any]:
    """Returns the speed of rejeu's program on the device."""
    import rejeu
    from rejeu import xla

    case = CASES[name]
    env = rejeu.make_vector(f"jax/{case.env}", case.n_envs)
    agent = rejeu.AGENTS[case.algorithm]("MlpPolicy", env, seed=0, **settings_of(name, "rejeu"))
    agent.on_device = True
    n_calls, chunks = 0, list[tuple[float, int]]()

    def watch(agent: Any, progress: Any) -> bool:
        nonlocal n_calls
        n_calls += 1
        if progress.step >= 2 * case.unit and n_calls > 5:
            chunks.append((time.perf_counter(), progress.step))
        return not chunks or chunks[-1][0] - chunks[0][0] < seconds

    agent.learn(10**9, watch)
    (began, first), (ended, last) = chunks[0], chunks[-1]
    rate = (last - first) / (ended - began)
    return {"steps_per_second": rate, "compile_seconds": xla.seconds(), "threads": xla.threads()}


def rejax_speed(name: str, seconds: float) -> dict[str, Any]:
    """Returns the speed of Rejax, whose program is compiled for ``unit`` steps and called with the state of the last call."""
    import jax
    import rejax

    case = CASES[name]
    length = {"total_timesteps": case.unit, "eval_freq": case.unit, "skip_initial_evaluation": True}
    algorithm = getattr(rejax, case.algorithm).create(
        env=case.env, num_envs=case.n_envs, **length, **settings_of(name, "rejax")
    )
    algorithm = algorithm.replace(eval_callback=lambda algorithm, state, key: ())
    began = time.perf_counter()
    state = jax.jit(algorithm.init_state)(jax.random.PRNGKey(0))
    train = jax.jit(lambda state: algorithm.train(train_state=state)[0], donate_argnums=0).lower(state).compile()
    compile_seconds = time.perf_counter() - began

    def call() -> None:
        nonlocal state
        state = jax.block_until_ready(train(state))

    return {**timed(call, case.unit, seconds), "compile_seconds": compile_seconds}


def sb3_speed(name: str, seconds: float) -> dict[str, Any]:
    """Returns the speed of Stable-Baselines3, which steps Gymnasium's environments in its process."""
    import gymnasium as gym
    import stable_baselines3
    import torch
    from stable_baselines3.common.vec_env import DummyVecEnv

    case, settings = CASES[name], settings_of(name, "sb3")
    settings["policy_kwargs"]["activation_fn"] = getattr(torch.nn, settings["policy_kwargs"]["activation_fn"])
    env = DummyVecEnv([lambda: gym.make(case.env)] * case.n_envs)
    agent = getattr(stable_baselines3, case.algorithm)("MlpPolicy", env, seed=0, device="cpu", **settings)
    n_steps = case.n_envs * settings.get("n_steps", 256)
    agent.learn(max(settings.get("learning_starts", 0), n_steps))
    timing = timed(lambda: agent.learn(n_steps, reset_num_timesteps=False), n_steps, seconds)
    return {**timing, "compile_seconds": 0.0, "threads": torch.get_num_threads()}


def timed(call: Any, n_steps: int, seconds: float) -> dict[str, float]:
    """Returns the steps per second of a function that takes ``n_steps``, after two calls that do not count."""
    call()
    call()
    n_calls, began = 0, time.perf_counter()
    while time.perf_counter() - began < seconds:
        call()
        n_calls += 1
    return {"steps_per_second": n_calls * n_steps / (time.perf_counter() - began)}


SPEEDS = {"rejeu": rejeu_speed, "rejax": rejax_speed, "sb3": sb3_speed}


def child(name: str, library: str, seconds: float) -> dict[str, Any]:
    """Returns a measurement with the versions of the packages."""
    found = SPEEDS[library](name, seconds)
    versions = {"python": platform.python_version()} | {name: metadata.version(name) for name in PACKAGES[library]}
    if library != "sb3":
        import jax

        found["device"] = f"{jax.devices()[0].device_kind} ({jax.default_backend()})"
    return {**found, "versions": versions}


def measure(name: str, library: str, threads: str, python: str, seconds: float) -> dict[str, Any]:
    """Returns a measurement made in a process of its own, or its error."""
    environment = {**os.environ, **THREADS[threads], "PYTHONWARNINGS": "ignore", "JAX_COMPILATION_CACHE_DIR": ""}
    if library == "rejeu":
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT / "src"), os.environ.get("PYTHONPATH", ""))))
    else:
        environment.pop("PYTHONPATH", None)
    words = [python, __file__, "--child", json.dumps([name, library, seconds])]
    found = {"case": name, "library": library, "threads_of_process": threads}
    return {**found, **in_process(*words, environment=environment)}


def all_measurements(
    cases: list[str], libraries: list[str], pythons: dict[str, str], rounds: int, seconds: float
) -> list[dict[str, Any]]:
    """Returns the measurements of all rounds; after the first one, peers run with the number of threads that was faster."""
    found: list[dict[str, Any]] = []
    for turn in range(rounds):
        for name in cases:
            for library in libraries:
                kinds = ["" if library == "rejeu" else fastest(found, name, library)] if turn else []
                for threads in kinds or ([""] if library == "rejeu" else ["all threads", "1 thread"]):
                    one = measure(name, library, threads, pythons[library], seconds)
                    found.append({"round": turn, **one})
                    print(json.dumps(found[-1]), flush=True)
    return found


def fastest(found: list[dict[str, Any]], name: str, library: str) -> str:
    """Returns the number of threads with which a peer was faster in the first round."""
    same = [one for one in found if (one["case"], one["library"], one["round"]) == (name, library, 0)]
    return max(same, key=lambda one: one.get("steps_per_second", 0.0))["threads_of_process"]


def summary(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns the medians by case and library, and the medians of the ratios of rejeu to each in the same round."""
    rows = []
    for name, library in dict.fromkeys((one["case"], one["library"]) for one in found):
        threads = fastest(found, name, library)
        key = (name, library, threads)
        good = [o for o in found if (o["case"], o["library"], o["threads_of_process"]) == key and "error" not in o]
        if not good:
            continue
        rates = [one["steps_per_second"] for one in good]
        own = {
            o["round"]: o["steps_per_second"]
            for o in found
            if o["case"] == name and o["library"] == "rejeu" and "error" not in o
        }
        ratios = [own[one["round"]] / one["steps_per_second"] for one in good if one["round"] in own]
        row = {"case": name, "library": library, "threads": threads, "rounds": len(good)}
        row |= {"steps_per_second": median(rates), "least": min(rates), "most": max(rates)}
        row |= {"compile_seconds": median(one["compile_seconds"] for one in good)}
        if library != "rejeu" and ratios:
            row |= {"rejeu_to_this": median(ratios), "least_ratio": min(ratios), "most_ratio": max(ratios)}
        rows.append(row)
    return rows


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", default=[*CASES], choices=[*CASES])
    parser.add_argument("--libraries", nargs="+", default=[*LIBRARIES], choices=LIBRARIES)
    parser.add_argument("--rejax-python", default=sys.executable, help="Python with Rejax")
    parser.add_argument("--sb3-python", default=sys.executable, help="Python with Stable-Baselines3")
    parser.add_argument("--seconds", type=float, default=8.0, help="of each measurement, after the start")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=RESULT)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child is not None:
        print(json.dumps(child(*json.loads(arguments.child))))
        return
    pythons = {"rejeu": sys.executable, "rejax": arguments.rejax_python, "sb3": arguments.sb3_python}
    found = all_measurements(arguments.cases, arguments.libraries, pythons, arguments.rounds, arguments.seconds)
    rows = summary(found)
    shown = {str(Path(arguments.rejax_python)): "PATH", str(Path(arguments.sb3_python)): "PATH"}
    content = {
        **provenance(shown),
        "machine": {"platform": platform.platform(), **machine()},
        "device": next((one["device"] for one in found if "device" in one), None),
        "versions": {one["library"]: one["versions"] for one in found if "versions" in one},
        "seconds": arguments.seconds,
        "settings": {name: [[*row] for row in SETTINGS[name]] for name in arguments.cases},
        "results": rows,
        "measurements": [{key: value for key, value in one.items() if key != "versions"} for one in found],
    }
    write(arguments.out, content)
    print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
