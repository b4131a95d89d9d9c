"""Measures seconds per environment step of PPO and A2C, including the updates."""

from __future__ import annotations

from typing import Any

from benchmarks.bench.work import common


def measure(
    library: str,
    algorithm: str,
    env: str,
    settings: dict[str, Any],
    seconds: float,
    n_envs: int,
    backend: str = "gymnasium",
    count: bool = False,
) -> dict[str, Any]:
    """Trains on ``n_envs`` environments with the hyperparameters ``settings``. ``count`` also counts the operations."""
    import gymnasium as gym

    if library == "rejeu":
        import rejeu

        vector: Any = rejeu.make_vector(env, n_envs, backend, seed=0)
    else:
        from stable_baselines3.common.vec_env import DummyVecEnv

        vector = DummyVecEnv([lambda: gym.make(env)] * n_envs)
    if library == "sb3":
        settings = {**settings, "device": "cpu"}
    agent = common.algorithm_of(library, algorithm)("MlpPolicy", vector, seed=0, **settings)
    unit = max(settings["n_steps"] * n_envs, 1)
    unit *= max(1, 320 // unit)
    result = common.time_learning(agent, library, warm_up=unit, unit=unit, seconds=seconds)
    result |= common.threads_used(agent, library, n_envs)
    if count:
        from benchmarks.bench.work import flops

        result |= flops.on_policy(agent, n_envs)
    return result


if __name__ == "__main__":
    common.main(measure)
