"""Measures steps per second of the environments with random actions, resets included.

    python benchmarks/environments.py functional --rounds 5
    python benchmarks/environments.py backends --rounds 7

``functional`` compares the environments in JAX with Gymnasium's and EnvPool's. There ``program`` is a loop compiled as one
program, with random actions and resets in it, as in training on the device; its compilation is reported apart. ``vector``
is the same environments behind ``rejeu.make_vector``, one call for each step. ``backends`` compares the backends for the
environments with presets and for LunarLander; worker processes only where a step takes a millisecond or more in this
process. The results are medians of the rounds, in which all are measured in turn. They are written to
``benchmarks/results/functional.json`` or ``backends.json``.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
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
from rejeu.lab.runs.config import versions

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import machine, provenance, write

RESULTS = Path(__file__).parent / "results"
PEERS = {
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
BACKENDS = {
    "CartPole-v1": (1, 4, 16),
    "Pendulum-v1": (1, 4, 16),
    "MountainCar-v0": (1, 16),
    "LunarLander-v3": (1, 16),
    "LunarLanderContinuous-v3": (1, 16),
    "FetchReach-v4": (1, 4),
    "parking-v0": (1, 16),
    "rejeu/Ball-v0": (8,),
}
"""Environments whose backends are measured, and their numbers."""
SLOW_STEP = 1e-3
"""Minimum duration of a step in this process, in seconds, for worker processes to be measured."""
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


def medians(contenders: dict[str, Callable[[], float]], rounds: int) -> dict[str, int]:
    """Returns the median rate of each contender; in each round all are measured in turn."""
    rates = [{name: rate() for name, rate in contenders.items()} for _ in range(rounds)]
    return {name: round(median(rates_of_round[name] for rates_of_round in rates)) for name in contenders}


def functional(env_id: str, n: int, rounds: int) -> dict[str, Any]:
    """Returns the rates of an environment in JAX and of its peer, and the time of compilation in seconds."""
    peer = PEERS[env_id]
    compiled, state, seconds = program(make(env_id), n)
    contenders = {
        "program": lambda: rate_of_program(compiled, state, n),
        "vector": lambda: rate_of_vector(env_id, n, "jax"),
    }
    if n <= MOST_GYMNASIUM:
        contenders["gymnasium"] = lambda: rate_of_vector(peer, n, "gymnasium")
    if n <= MOST_GYMNASIUM and envpool_knows(peer):
        contenders["envpool"] = lambda: rate_of_vector(peer, n, "envpool")
    return {"compile_seconds": round(seconds, 2), "steps_per_second": medians(contenders, rounds)}


def backends(env_id: str, n: int, rounds: int) -> dict[str, Any]:
    """Returns the rates of the backends that an environment has."""
    names = ("envpool", "gymnasium") if envpool_knows(env_id) else ("gymnasium",)
    rates = medians({name: partial(rate_of_vector, env_id, n, name) for name in names}, rounds)
    if n > 1 and rates["gymnasium"] * SLOW_STEP < 1.0:
        rates |= medians({"gymnasium-async": partial(rate_of_vector, env_id, n, "gymnasium-async")}, rounds)
    return {"steps_per_second": rates}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=["functional", "backends"])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", nargs="*", help="environments to measure, instead of all")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    cases = dict.fromkeys(PEERS, NUMBERS) if arguments.what == "functional" else BACKENDS
    measure, rows = {"functional": functional, "backends": backends}[arguments.what], []
    for env_id in arguments.only or cases:
        for n in cases[env_id]:
            rows.append({"env": env_id, "n_envs": n, **measure(env_id, n, arguments.rounds)})
            print(rows[-1], flush=True)
    here = {**machine(), "device": jax.devices()[0].device_kind}
    out = arguments.out or RESULTS / f"{arguments.what}.json"
    write(out, {**provenance(), "machine": here, "versions": versions(), "results": rows})


if __name__ == "__main__":
    main()
