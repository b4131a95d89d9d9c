"""Measures whether the loop of the host would be faster with its replay buffer on the device.

    python benchmarks/device_replay.py

Three loops train the same agent in one Gymnasium environment, with one update for each step:

- ``host``: batches are taken from the replay buffer by NumPy, as in :func:`rejeu.loops.off_policy.off_policy`;
- ``two calls``: the rows are on the device; one call chooses the action, and one stores the step, takes the batch and updates;
- ``one call``: a single call does all of that, so the environment cannot step during the update.

All draw the same rows with the same random numbers; the largest difference of the final networks is reported. Callbacks,
history and checks for NaN are left out of all three. Each loop is timed several times, in turn with the others. The medians,
in microseconds for each step, are written to ``benchmarks/results/device_replay.json``, with the time in which NumPy takes
a batch.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import rejeu
from rejeu.buffers.device import DeviceReplay, DeviceRing, uploaded
from rejeu.core import Clock, Transition
from rejeu.loops.checks import checked_reset
from rejeu.loops.run import clock_of
from rejeu.spaces import action_scaler

ROOT = Path(__file__).resolve().parents[1]
RESULT = ROOT / "benchmarks" / "results" / "device_replay.json"
CASES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "SAC, 64-64": ("SAC", "Pendulum-v1", {"batch_size": 64, "policy_kwargs": {"net_arch": [64, 64]}}),
    "SAC, 256-256": ("SAC", "Pendulum-v1", {"batch_size": 256, "policy_kwargs": {"net_arch": [256, 256]}}),
    "DDPG, 128-128": ("DDPG", "Pendulum-v1", {"batch_size": 128, "policy_kwargs": {"net_arch": [128, 128]}}),
    "DQN, 128-128": (
        "DQN", "MountainCar-v0",
        {"batch_size": 128, "policy_kwargs": {"net_arch": [128, 128]}, "train_freq": 1, "gradient_steps": 1},
    ),
}  # fmt: skip
"""Algorithm, environment and settings by name; those of ``docs/performance.md``."""
WARM_UP = 1_000


class Taken(NamedTuple):
    """One step of the environment."""

    action: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    next_obs: np.ndarray
    ended: np.ndarray
    obs: np.ndarray
    """The observation to act on: of a new episode where one ended."""


def make(name: str) -> Any:
    """Returns an agent after the warm-up."""
    algorithm, env, settings = CASES[name]
    agent = rejeu.AGENTS[algorithm]("MlpPolicy", env, seed=0, learning_starts=100, buffer_size=100_000, **settings)
    return agent.learn(WARM_UP)


def step(agent: Any, action: np.ndarray) -> Taken:
    """Steps the environment, stores the step on the host, and begins an episode where one ended."""
    run = agent.run
    result = run.env.step(action_scaler(run.env.action_space)(action))
    run.replay.add(action, result.reward, result.terminated, result.obs)
    run.step += 1
    run.ended = result.terminated | result.truncated
    obs = next_obs = result.obs
    if np.count_nonzero(run.ended):
        next_obs = np.copy(next_obs)
        obs = checked_reset(run, run.ended)
        run.replay.begin(obs, np.flatnonzero(run.ended))
    run.obs = obs
    return Taken(action, result.reward, result.terminated, next_obs, run.ended, obs)


def on_host(agent: Any, n: int) -> None:
    """Trains for ``n`` steps with batches taken by NumPy."""
    run, learner, shape = agent.run, agent.learner, (agent.config.batch_size,)
    for _ in range(n):
        step(agent, run.action)
        clock = clock_of(run, 0.5)
        chosen, run.carry = learner.act(run.state, run.carry, run.obs, run.ended, run.key, clock)
        batch = run.replay.sample(run.rng, shape)
        run.state, run.metrics, _ = learner.update(run.state, batch, clock)
        run.action = np.asarray(chosen)


def stored(replay: DeviceReplay, ring: DeviceRing, taken: Taken) -> DeviceRing:
    """Returns the ring after a step."""
    ring = replay.add(ring, taken.action, taken.reward, taken.terminated, taken.next_obs, jnp.ones(1, bool))
    return replay.begin(ring, taken.obs, taken.ended)


def gathered(agent: Any, replay: DeviceReplay, ring: DeviceRing, position: Array) -> Transition:
    """Returns the batch of rows that the host has drawn."""
    following = (position + 1) % replay.rows
    discount = jnp.asarray(agent.run.replay.discounts)[ring.kind[position]]
    return Transition(
        ring.obs[0][position], ring.action[position], ring.reward[position], ring.obs[0][following], discount
    )


def with_two_calls(agent: Any) -> Callable[[Any, int], None]:
    """Returns the loop that acts in one call; another stores, takes the batch and updates."""
    replay = replay_of(agent)

    @partial(jax.jit, donate_argnums=(0, 1))
    def update(state: Any, ring: DeviceRing, taken: Taken, position: Array, clock: Clock) -> Any:
        ring = stored(replay, ring, taken)
        state, readings, _ = agent.learner._update(state, gathered(agent, replay, ring, position), clock)
        return state, ring, readings

    def loop(agent: Any, n: int) -> None:
        run, learner, ring = agent.run, agent.learner, uploaded(replay, agent.run.replay.ring)
        for _ in range(n):
            taken = step(agent, run.action)
            clock = clock_of(run, 0.5)
            chosen, run.carry = learner.act(run.state, run.carry, run.obs, run.ended, run.key, clock)
            position = run.replay.ring.draw(run.rng, agent.config.batch_size).position.astype(np.int32)
            run.state, ring, run.metrics = update(run.state, ring, taken, position, clock)
            run.action = np.asarray(chosen)

    return loop


def with_one_call(agent: Any) -> Callable[[Any, int], None]:
    """Returns the loop that does everything but the step of the environment in one call."""
    replay, learner = replay_of(agent), agent.learner

    @partial(jax.jit, donate_argnums=(0, 1))
    def turn(state: Any, ring: DeviceRing, carry: Any, key: Array, taken: Taken, position: Array, clock: Clock) -> Any:
        chosen, carry = learner._act(learner.explorer, state, carry, taken.obs, taken.ended, key, clock)
        chosen, state = jax.lax.optimization_barrier((chosen, state))  # the action is that of the old weights
        ring = stored(replay, ring, taken)
        state, readings, _ = learner._update(state, gathered(agent, replay, ring, position), clock)
        return state, ring, carry, chosen, readings

    def loop(agent: Any, n: int) -> None:
        run, ring = agent.run, uploaded(replay, agent.run.replay.ring)
        for _ in range(n):
            taken = step(agent, run.action)
            position = run.replay.ring.draw(run.rng, agent.config.batch_size).position.astype(np.int32)
            run.state, ring, run.carry, chosen, run.metrics = turn(
                run.state, ring, run.carry, run.key, taken, position, clock_of(run, 0.5)
            )
            run.action = np.asarray(chosen)

    return loop


def replay_of(agent: Any) -> DeviceReplay:
    """Returns the functions of the replay buffer on the device."""
    ring = agent.run.replay.ring
    return DeviceReplay(ring.rows, 1, ring.obs_structure, agent.config.gamma, agent.config.batch_size)


def weights(agent: Any) -> np.ndarray:
    """Returns all floating-point numbers of the state; waits for the device."""
    return np.concatenate([np.ravel(part) for part in map(np.asarray, agent.run.state) if part.dtype.kind == "f"])


def measure(name: str, n: int, rounds: int) -> dict[str, Any]:
    """Returns the times of a case."""
    agents = {kind: make(name) for kind in ("host", "two calls", "one call")}
    loops = {
        "host": on_host,
        "two calls": with_two_calls(agents["two calls"]),
        "one call": with_one_call(agents["one call"]),
    }
    differences = {}
    for kind, loop in loops.items():  # compiles
        loop(agents[kind], 50)
        differences[kind] = float(np.abs(weights(agents[kind]) - weights(agents["host"])).max())
    times: dict[str, list[float]] = {kind: [] for kind in loops}
    for _ in range(rounds):
        for kind, loop in loops.items():
            begun = time.perf_counter()
            loop(agents[kind], n)
            jax.block_until_ready(agents[kind].run.state)
            times[kind].append(1e6 * (time.perf_counter() - begun) / n)
    replay, rng, shape = agents["host"].run.replay, np.random.default_rng(0), (agents["host"].config.batch_size,)
    begun = time.perf_counter()
    for _ in range(n):
        replay.sample(rng, shape)
    return {
        "case": name,
        "microseconds": {kind: median(found) for kind, found in times.items()},
        "of_each_round": times,
        "batch_by_numpy_microseconds": 1e6 * (time.perf_counter() - begun) / n,
        "largest_difference_after_50_steps": differences,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", default=[*CASES], choices=[*CASES])
    parser.add_argument("--steps", type=int, default=4_000)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--out", type=Path, default=RESULT)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        print(json.dumps(measure(arguments.child, arguments.steps, arguments.rounds)))
        return
    results = []
    for name in arguments.cases:
        words = [sys.executable, __file__, "--child", name]
        words += ["--steps", str(arguments.steps), "--rounds", str(arguments.rounds)]
        done = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=True)
        results.append(json.loads(done.stdout.strip().splitlines()[-1]))
        print(results[-1], flush=True)
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    content = {
        "command": shlex.join(["python", "benchmarks/device_replay.py", *sys.argv[1:]]),
        "commit": commit.stdout.strip(),
        "date": time.strftime("%Y-%m-%d"),
        "machine": {
            "cores": os.cpu_count(),
            "python": platform.python_version(),
            "device": jax.devices()[0].device_kind,
        },
        "results": results,
    }
    arguments.out.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
