"""Compares agents with and without random network distillation where the only reward is far from the start.

    python benchmarks/exploration.py            # 5 seeds, some minutes on one core

A chain of cells: in each, one of two actions leads to the next cell and the other back to the start, and the end gives 1. At
random, an attempt succeeds once in ``2 ** N_CELLS``. Hyperparameters are the same with and without the bonus, and were not
tuned. Results go to ``benchmarks/results/exploration.json``: by agent, the step at which training reached the end first, the
share of the training episodes in the last tenth that reach it, with the 95 % interval of the mean over the seeds, and that of
100 episodes of the deterministic policy after training.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import rejeu
from rejeu.envs.functional import FunctionalEnv
from trials.provenance import half_interval, machine, provenance, write

RESULT = Path(__file__).parent / "results" / "exploration.json"
N_CELLS = 16
RIGHT = np.random.default_rng(0).integers(0, 2, N_CELLS)
"""The action that leads on, by cell."""
STEPS = 50_000
SHARED: dict[str, Any] = {"policy_kwargs": {"net_arch": [64, 64]}, "gamma": 0.99}
OFF = {"learning_rate": 1e-3, "learning_starts": 1000, "buffer_size": 50_000, "batch_size": 64, "train_freq": 4}
AGENTS: dict[str, tuple[int, dict[str, Any]]] = {
    "PPO": (8, {**SHARED, "n_steps": 128, "batch_size": 256, "ent_coef": 0.01, "learning_rate": 1e-3}),
    "DQN": (1, {**SHARED, **OFF, "target_update_interval": 500, "exploration_fraction": 0.2}),
}
"""Numbers of environments and hyperparameters."""


class Place(NamedTuple):
    """The cell, and the steps of the episode."""

    cell: Array
    time: Array


class Chain(FunctionalEnv):
    """A chain of cells of which a wrong action leads back to the first."""

    max_episode_steps: int | None = eqx.field(static=True, default=4 * N_CELLS)

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(0.0, 1.0, (N_CELLS,), np.float32)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(2)

    def reset(self, key: Array) -> tuple[Place, Array]:
        state = Place(jnp.int32(0), jnp.int32(0))
        return state, self.observe(state)

    def step(self, key: Array, state: Place, action: Array) -> tuple[Place, Array, Array, Array, Array]:
        goes_on = jnp.asarray(RIGHT)[state.cell] == action
        ends = goes_on & (state.cell == N_CELLS - 1)
        after = Place(jnp.where(goes_on & ~ends, state.cell + 1, 0).astype(jnp.int32), state.time + 1)
        return after, self.observe(after), jnp.float32(ends), ends, after.time >= self.max_episode_steps

    def observe(self, state: Place) -> Array:
        return jax.nn.one_hot(state.cell, N_CELLS, dtype=jnp.float32)


def train(algorithm: str, rnd: float | None, seed: int) -> dict[str, Any]:
    n_envs, settings = AGENTS[algorithm]
    vector = rejeu.make_vector(Chain(), n_envs, seed=seed)
    agent = rejeu.AGENTS[algorithm]("MlpPolicy", vector, seed=seed, rnd=rnd, **settings).learn(STEPS)
    reached = np.flatnonzero(agent.history["return"] > 0)
    result = agent.evaluate(100, env=rejeu.make_vector(Chain(), 10, seed=10_000 + seed))
    first = int(agent.history["step"][reached[0]]) if len(reached) else None
    late = agent.history["return"][agent.history["step"] > 0.9 * STEPS]
    return {"seed": seed, "first_reached": first, "reached": float(np.mean(late)), "deterministic": result.mean_return}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", choices=AGENTS, default=[*AGENTS])
    parser.add_argument("--seeds", type=int, nargs="*", default=[*range(5)])
    arguments = parser.parse_args()
    results = []
    for algorithm in arguments.only:
        for rnd in (None, 1.0):
            runs = [train(algorithm, rnd, seed) for seed in arguments.seeds]
            shares = [run["reached"] for run in runs]
            mean, half = float(np.mean(shares)), half_interval(shares)
            row = {"algorithm": algorithm, "rnd": rnd, "steps": STEPS, "reached": round(mean, 4)}
            row |= {"interval": [round(mean - half, 4), round(mean + half, 4)], "runs": runs}
            print({key: row[key] for key in ("algorithm", "rnd", "reached", "interval")}, runs, flush=True)
            results.append(row)
            write(RESULT, {**provenance(), "machine": machine(), "results": results}, rows="results")


if __name__ == "__main__":
    main()
