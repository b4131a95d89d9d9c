"""Compares agents with and without action masks, and with and without memory, where some actions are invalid.

    python benchmarks/invalid_actions.py            # both tasks, 5 seeds; about 15 minutes on one core

In *maze*, moves into walls are invalid: they take a step and lead nowhere. The observation holds the cell and the walls around
it, so masks tell the agent nothing that it does not see. In *doors*, a sign at the start says which of two doors at the end is
the right one. On the way there only two of eight actions are valid, others at each step, which the observation shows. Without
memory the right door can only be guessed.

Hyperparameters are the same with and without masks, and were not tuned. Results go to
``benchmarks/results/invalid_actions.json``: by task and agent, the mean return of 200 episodes of the deterministic policy
after training, and that of the training episodes in each tenth of the run, with the seeds behind them.
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
from scipy import stats

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import rejeu
from rejeu.envs.functional import FunctionalEnv
from trials.provenance import machine, provenance, write

RESULT = Path(__file__).parent / "results" / "invalid_actions.json"
LAYOUT = (
    "#############",
    "#   #       #",
    "# # # ##### #",
    "# #   #   # #",
    "# ##### # # #",
    "#   #   # # #",
    "### # ### # #",
    "#   # #   # #",
    "# ### # ### #",
    "# #   #   # #",
    "# # ##### # #",
    "#   #      G#",
    "#############",
)
WALLS = np.array([[cell == "#" for cell in row] for row in LAYOUT])
GOAL = np.argwhere([[cell == "G" for cell in row] for row in LAYOUT])[0]
FREE = np.argwhere([[cell == " " for cell in row] for row in LAYOUT])
MOVES = np.array([[-1, 0], [1, 0], [0, -1], [0, 1]])


class Place(NamedTuple):
    """Where the agent is, and the steps of the episode."""

    cell: Array
    time: Array


class Maze(FunctionalEnv):
    """From a random cell to the goal; a step costs 0.01 and the goal gives 1."""

    max_episode_steps: int | None = eqx.field(static=True, default=100)

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(0.0, 1.0, (WALLS.size + 4,), np.float32)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(4)

    def reset(self, key: Array) -> tuple[Place, Array]:
        state = Place(jnp.asarray(FREE)[jax.random.randint(key, (), 0, len(FREE))], jnp.int32(0))
        return state, self.observe(state)

    def step(self, key: Array, state: Place, action: Array) -> tuple[Place, Array, Array, Array, Array]:
        moves = self.action_mask(state)[action]
        after = Place(state.cell + jnp.where(moves, jnp.asarray(MOVES)[action], 0), state.time + 1)
        reached = (after.cell == jnp.asarray(GOAL)).all()
        return after, self.observe(after), jnp.where(reached, 1.0, -0.01), reached, after.time >= self.max_episode_steps

    def observe(self, state: Place) -> Array:
        cell = jax.nn.one_hot(state.cell[0] * WALLS.shape[1] + state.cell[1], WALLS.size)
        return jnp.concatenate([cell, self.action_mask(state)]).astype(jnp.float32)

    def action_mask(self, state: Place) -> Array:
        around = state.cell + jnp.asarray(MOVES)
        return ~jnp.asarray(WALLS)[around[:, 0], around[:, 1]]


class Walk(NamedTuple):
    """The right door, the valid actions, steps forward, and the steps of the episode."""

    door: Array
    valid: Array
    position: Array
    time: Array


class Doors(FunctionalEnv):
    """Six valid actions lead to two doors; the right one gives 1, and an invalid action costs 0.1."""

    max_episode_steps: int | None = eqx.field(static=True, default=20)
    length: int = eqx.field(static=True, default=6)

    @property
    def observation_space(self) -> spaces.Box:
        return spaces.Box(-1.0, 1.0, (10,), np.float32)

    @property
    def action_space(self) -> spaces.Discrete:
        return spaces.Discrete(8)

    def reset(self, key: Array) -> tuple[Walk, Array]:
        sign_key, valid_key = jax.random.split(key)
        state = Walk(jax.random.randint(sign_key, (), 0, 2), draw(valid_key), jnp.int32(0), jnp.int32(0))
        return state, self.observe(state)

    def step(self, key: Array, state: Walk, action: Array) -> tuple[Walk, Array, Array, Array, Array]:
        is_valid = state.valid[action]
        chooses = (state.position == self.length) & is_valid
        position = state.position + (is_valid & ~chooses)
        valid = jnp.where(position == self.length, jnp.arange(8) < 2, draw(key))
        after = Walk(state.door, valid, position, state.time + 1)
        reward = jnp.where(chooses, (action == state.door).astype(jnp.float32), jnp.where(is_valid, 0.0, -0.1))
        return after, self.observe(after), reward, chooses, after.time >= self.max_episode_steps

    def observe(self, state: Walk) -> Array:
        sign = jnp.where(state.time == 0, 2 * state.door - 1, 0)
        return jnp.concatenate([sign[None], state.position[None] / self.length, state.valid]).astype(jnp.float32)

    def action_mask(self, state: Walk) -> Array:
        return state.valid


def draw(key: Array) -> Array:
    """Returns two random ones of eight actions as valid."""
    return jax.random.permutation(key, jnp.arange(8) < 2)


SMALL: dict[str, Any] = {"policy_kwargs": {"net_arch": [64, 64]}}
OFF = {**SMALL, "learning_rate": 1e-3, "learning_starts": 1000, "buffer_size": 50_000, "batch_size": 64}
Q = {**OFF, "train_freq": 4, "target_update_interval": 500, "exploration_fraction": 0.5}
ON = {**SMALL, "n_steps": 128, "batch_size": 256, "ent_coef": 0.01}
MEMORY = {**ON, "policy_kwargs": {"net_arch": [64], "lstm_hidden_size": 32}, "learning_rate": 1e-3}
TASKS: dict[str, Any] = {
    "maze": (Maze(), 30_000, {"DQN": (1, Q), "QRDQN": (1, Q), "SAC": (1, {**OFF, "train_freq": 2}), "PPO": (8, ON)}),
    "doors": (Doors(), 100_000, {"PPO": (8, {**ON, "learning_rate": 1e-3}), "RecurrentPPO": (8, MEMORY)}),
}
"""Environment, steps, and agents with their numbers of environments and hyperparameters, by task."""


def train(task: str, algorithm: str, masks: bool, seed: int) -> dict[str, Any]:
    env, steps, agents = TASKS[task]
    n_envs, settings = agents[algorithm]
    vector = rejeu.make_vector(env, n_envs, seed=seed)
    agent = rejeu.AGENTS[algorithm]("MlpPolicy", vector, seed=seed, action_masks=masks, **settings)
    agent.learn(steps)
    at = np.minimum((agent.history["step"] - 1) * 10 // steps, 9)
    tenths = [float(agent.history["return"][at == i].mean()) if (at == i).any() else None for i in range(10)]
    result = agent.evaluate(200, env=rejeu.make_vector(env, 16, seed=10_000 + seed))
    return {"seed": seed, "mean_return": result.mean_return, "training": tenths}


def interval(values: list[float]) -> list[float]:
    """Returns the 95 % interval of the mean by Student's t distribution."""
    mean, error = float(np.mean(values)), float(stats.sem(values))
    half = error * float(stats.t.ppf(0.975, len(values) - 1))
    return [round(mean - half, 4), round(mean + half, 4)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="*", choices=TASKS, default=[*TASKS])
    parser.add_argument("--seeds", type=int, nargs="*", default=[*range(5)])
    arguments = parser.parse_args()
    results = []
    for task in arguments.tasks:
        for algorithm in TASKS[task][2]:
            for masks in (False, True):
                runs = [train(task, algorithm, masks, seed) for seed in arguments.seeds]
                returns = [run["mean_return"] for run in runs]
                row = {"task": task, "algorithm": algorithm, "action_masks": masks, "steps": TASKS[task][1]}
                row |= {"mean_return": round(float(np.mean(returns)), 4), "interval": interval(returns), "runs": runs}
                print(task, algorithm, masks, row["mean_return"], row["interval"], flush=True)
                results.append(row)
    write(RESULT, {**provenance(), "machine": machine(), "results": results}, rows="results")


if __name__ == "__main__":
    main()
