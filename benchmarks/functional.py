"""Measures steps per second of the environments in JAX, next to Gymnasium's and EnvPool's, with random actions.

    python benchmarks/functional.py [--rounds 5]

``program`` is a loop compiled as one program, with random actions and resets in it, as in training on the device; its
compilation is reported apart. ``vector`` is the same environments behind ``rejeu.make_vector``, one call for each step. The
result is the median of the rounds, in which all are measured in turn. It is written to
``benchmarks/results/functional.json``.
"""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import closing
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import gymnasium as gym
import jax
import jax.numpy as jnp

from rejeu.envs.envpool import envpool_knows
from rejeu.envs.functional import FunctionalEnv, make
from rejeu.envs.functional.vector import VectorState, reset_all, reset_done, step_all
from rejeu.envs.make import make_vector
from rejeu.runs.config import versions

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import machine, provenance, write

RESULT = Path(__file__).parent / "results" / "functional.json"
CASES = {
    "jax/CartPole-v1": "CartPole-v1",
    "jax/Pendulum-v1": "Pendulum-v1",
    "jax/Acrobot-v1": "Acrobot-v1",
    "jax/Ball-v0": "rejeu/Ball-v0",
    "jax/Parking-v0": "parking-v0",
}
"""Ids of the environments in JAX and of their counterparts."""
NUMBERS = (1, 64, 2048)
MOST_GYMNASIUM = 64
"""Largest number of environments that are stepped one after the other in this process, or made by EnvPool."""
ROUND_SECONDS = 0.3
"""Duration of one measurement, in seconds."""
N_TURNS = {1: 5_000, 64: 1_000, 2048: 50}
"""Steps of all environments in one call of the program."""


def random_actions(space: gym.Space, key: jax.Array, n: int) -> jax.Array:
    if isinstance(space, gym.spaces.Discrete):
        return jax.random.randint(key, (n,), 0, int(space.n))
    assert isinstance(space, gym.spaces.Box)
    return jax.random.uniform(key, (n, *space.shape), minval=jnp.asarray(space.low), maxval=jnp.asarray(space.high))


def program(env: FunctionalEnv, n: int) -> Any:
    """Returns the compiled loop, and the time in seconds that its compilation took."""

    def turn(state: VectorState, key: jax.Array) -> tuple[VectorState, jax.Array]:
        action = random_actions(env.action_space, key, n)
        state, _, reward, terminated, truncated, _ = step_all(env, state, action)
        return reset_done(env, state, terminated | truncated)[0], reward.sum()

    def run(state: VectorState, key: jax.Array) -> tuple[VectorState, jax.Array]:
        return jax.lax.scan(turn, state, jax.random.split(key, N_TURNS[n]))

    state = jax.jit(partial(reset_all, env, n=n))(jax.random.key(0))
    began = time.perf_counter()
    compiled = jax.jit(run).lower(state, jax.random.key(0)).compile()
    return compiled, state, time.perf_counter() - began


def rate_of_program(compiled: Any, state: VectorState, n: int) -> float:
    n_calls, began = 0, time.perf_counter()
    while n_calls < 2 or time.perf_counter() - began < ROUND_SECONDS:
        state, rewards = compiled(state, jax.random.key(n_calls))
        jax.block_until_ready(rewards)
        n_calls += 1
    return n_calls * N_TURNS[n] * n / (time.perf_counter() - began)


def rate_of_vector(env_id: str, n: int, backend: str) -> float:
    with closing(make_vector(env_id, n, backend, seed=0)) as vector:  # type: ignore[arg-type]
        space = gym.vector.utils.batch_space(vector.action_space, n)
        space.seed(0)
        actions = [space.sample() for _ in range(16)]
        vector.reset()
        vector.reset_done(vector.step(actions[0]).terminated | True)  # compiles both
        n_steps, began = 0, time.perf_counter()
        while n_steps < 5 or time.perf_counter() - began < ROUND_SECONDS:
            step = vector.step(actions[n_steps % len(actions)])
            n_steps += 1
            if (done := step.terminated | step.truncated).any():
                vector.reset_done(done)
        return n_steps * n / (time.perf_counter() - began)


def measure(env_id: str, peer: str, n: int, rounds: int) -> dict[str, Any]:
    """Returns the medians of the rounds, and the time of compilation in seconds."""
    env = make(env_id)
    compiled, state, seconds = program(env, n)
    contenders = {
        "program": lambda: rate_of_program(compiled, state, n),
        "vector": lambda: rate_of_vector(env_id, n, "jax"),
    }
    if n <= MOST_GYMNASIUM:
        contenders["gymnasium"] = lambda: rate_of_vector(peer, n, "gymnasium")
    if n <= MOST_GYMNASIUM and envpool_knows(peer):
        contenders["envpool"] = lambda: rate_of_vector(peer, n, "envpool")
    found = [{name: rate() for name, rate in contenders.items()} for _ in range(rounds)]
    rates = {name: round(median(one[name] for one in found)) for name in contenders}
    return {"env": env_id, "n_envs": n, "compile_seconds": round(seconds, 2), "steps_per_second": rates}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", nargs="*", default=[*CASES])
    parser.add_argument("--out", type=Path, default=RESULT)
    given = parser.parse_args()
    rows = []
    for env_id in given.only:
        for n in NUMBERS:
            rows.append(measure(env_id, CASES[env_id], n, given.rounds))
            print(rows[-1], flush=True)
    here = {**machine(), "device": jax.devices()[0].device_kind}
    write(given.out, {**provenance(), "machine": here, "versions": versions(), "results": rows})


if __name__ == "__main__":
    main()
