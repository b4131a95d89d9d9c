"""Measures the limits of the machine: environment steps without an agent, and the fastest matrix product."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from benchmarks.bench.work import common

SIZES = (128, 256, 512, 1024, 2048)


def measure(quantity: str, **arguments: Any) -> dict[str, Any]:
    """Measures ``"peak"`` or ``"env"``."""
    return peak(**arguments) if quantity == "peak" else env_steps(**arguments)


def env_steps(env: str, n_envs: int, backend: str, seconds: float) -> dict[str, Any]:
    """Returns seconds per environment step with random actions and resets, in rejeu's vector environments."""
    import copy

    from gymnasium.vector.utils import batch_space

    import rejeu

    vector = rejeu.make_vector(env, n_envs, backend, seed=0)
    space = batch_space(copy.deepcopy(vector.action_space), n_envs)
    space.seed(0)
    actions = [space.sample() for _ in range(64)]
    vector.reset()
    n_steps = 0

    def step() -> None:
        nonlocal n_steps
        result = vector.step(actions[n_steps % len(actions)])
        n_steps += 1
        done = result.terminated | result.truncated
        if done.any():
            vector.reset_done(done)

    return {"seconds_per_step": common.seconds_of(step, seconds, warm_up=1 + 2000 // n_envs, chunks=5) / n_envs}


def peak(seconds: float) -> dict[str, Any]:
    """Returns the highest rate of operations per second in products of square float32 matrices, by NumPy and by XLA."""
    import jax
    import jax.numpy as jnp

    rng = np.random.default_rng(0)
    product = jax.jit(jnp.matmul)
    rates: dict[str, float] = {}
    for size in SIZES:
        a, b = (rng.standard_normal((size, size)).astype(np.float32) for _ in range(2))
        out, on_device = np.empty_like(a), (jnp.asarray(a), jnp.asarray(b))
        ways = {
            "numpy": lambda a=a, b=b, out=out: np.matmul(a, b, out=out),
            "xla": lambda pair=on_device: product(*pair).block_until_ready(),
        }
        for way, act in ways.items():
            rates[f"{way} {size}"] = 2 * size**3 / shortest(act, seconds / (2 * len(SIZES)))
    best = max(rates, key=lambda name: rates[name])
    return {"flops_per_second": rates[best], "best": best, "rates": rates}


def shortest(act: Any, seconds: float) -> float:
    """Returns the minimum duration of ``act()`` over at least three calls, in seconds."""
    act()
    durations, began = [], time.perf_counter()
    while len(durations) < 3 or time.perf_counter() - began < seconds:
        start = time.perf_counter()
        act()
        durations.append(time.perf_counter() - start)
    return min(durations)


if __name__ == "__main__":
    common.main(measure)
