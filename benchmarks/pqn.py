"""Measures how long PQN takes in JAX's CartPole-v1 until the greedy policy has a mean return of 500.

    python benchmarks/pqn.py
    python benchmarks/pqn.py --seeds 0 1 --episodes 20

Every seed is trained in a process of its own with the preset of ``CartPole-v1``, on the device. The greedy policy is
evaluated in ``--episodes`` new episodes every ``--every`` steps until their mean return reaches ``--target``. The time is the
wall time of ``learn`` up to then, evaluations included and tracing and compiling not, which is reported as
``compile_seconds``. Then the agent is trained to the end of the preset and evaluated again. The results are written to
``benchmarks/results/pqn.json`` with the command, the commit and the device, and printed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import in_process, machine, provenance, write

RESULT = Path(__file__).parent / "results" / "pqn.json"
ENV = "jax/CartPole-v1"
SHARED = ("device", "threads", "versions")
"""What is equal for all seeds."""


class Watch:
    """Evaluates the greedy policy and notes when it first reached the target."""

    def __init__(self, every: int, episodes: int, target: float) -> None:
        self.every, self.episodes, self.target = every, episodes, target
        self.found: dict[str, Any] = {}
        self.evaluations: list[tuple[int, float]] = []
        self.next = every

    def __call__(self, agent: Any, progress: Any) -> None:
        from rejeu import xla

        if progress.step < self.next or self.found:
            return
        self.next = progress.step + self.every
        mean = agent.evaluate(self.episodes, ENV, seed=10_000 + agent.seed).mean_return
        self.evaluations.append((progress.step, mean))
        if mean >= self.target:
            wall, compiling = time.perf_counter() - self.began, xla.seconds() - self.compiled
            self.found = {"seconds": wall - compiling, "steps": progress.step, "compile_seconds": compiling}

    def start(self) -> None:
        """Starts the clock."""
        from rejeu import xla

        self.began, self.compiled = time.perf_counter(), xla.seconds()


def child(seed: int, every: int, episodes: int, target: float) -> dict[str, Any]:
    """Returns the measurement of a seed."""
    import jax

    import rejeu
    from rejeu import presets, xla
    from rejeu.runs.config import versions

    preset = presets.find(ENV, "PQN")
    assert preset is not None
    env = rejeu.make_vector(ENV, preset.n_envs, seed=seed)
    agent = rejeu.PQN("MlpPolicy", env, seed=seed, **preset.hyperparameters)
    watch = Watch(every, episodes, target)
    watch.start()
    agent.learn(preset.total_steps, watch)
    whole, compiling = time.perf_counter() - watch.began, xla.seconds() - watch.compiled
    final = agent.evaluate(100, ENV, seed=20_000 + seed)
    return {
        "seed": seed,
        "reached": watch.found or None,
        "evaluations": watch.evaluations,
        "whole_run": {
            "seconds": whole - compiling,
            "compile_seconds": compiling,
            "steps": agent.num_timesteps,
            "mean_return": float(final.mean_return),
        },
        "device": f"{jax.devices()[0].device_kind} ({jax.default_backend()})",
        "threads": xla.threads(),
        "versions": versions(),
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--every", type=int, default=20_000, help="environment steps between two evaluations")
    parser.add_argument("--episodes", type=int, default=20, help="of each evaluation")
    parser.add_argument("--target", type=float, default=500.0, help="mean return to reach")
    parser.add_argument("--out", type=Path, default=RESULT)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child is not None:
        print(json.dumps(child(*json.loads(arguments.child))))
        return
    from rejeu import presets

    runs = []
    for seed in arguments.seeds:
        asked = json.dumps([seed, arguments.every, arguments.episodes, arguments.target])
        runs.append(in_process(sys.executable, __file__, "--child", asked))
        if "error" in runs[-1]:
            raise SystemExit(f"seed {seed} failed: {runs[-1]['error']}")
        print(line(runs[-1]), flush=True)
    preset = presets.find(ENV, "PQN")
    assert preset is not None
    shared = {name: runs[0][name] for name in SHARED}
    times = [run["reached"]["seconds"] for run in runs if run["reached"]]
    content = {
        **provenance(),
        "machine": machine(),
        **shared,
        "env": ENV,
        "hyperparameters": dict(preset.hyperparameters),
        "n_envs": preset.n_envs,
        "target": arguments.target,
        "episodes": arguments.episodes,
        "summary": {
            "reached": f"{len(times)} of {len(runs)}",
            "seconds": [min(times), max(times)] if times else None,
        },
        "runs": [{name: run[name] for name in run if name not in SHARED} for run in runs],
    }
    write(arguments.out, content)


def line(run: dict[str, Any]) -> str:
    """Returns what is printed of a seed."""
    reached, whole = run["reached"], run["whole_run"]
    when = "not reached" if reached is None else f"after {reached['seconds']:.1f} s and {reached['steps']:,} steps"
    return (
        f"seed {run['seed']}: {when}; compiling {whole['compile_seconds']:.1f} s; whole run {whole['seconds']:.1f} s, "
        f"mean return {whole['mean_return']:.1f}"
    )


if __name__ == "__main__":
    main()
