"""Measures seconds per environment step of off-policy algorithms, including the updates."""

from __future__ import annotations

from typing import Any

from benchmarks.bench.work import common

WARM_UP, UNIT = 304, 104
"""Environment steps before timing starts, and the unit of the timed steps. Both are multiples of 8 environments."""


def measure(
    library: str,
    algorithm: str,
    env: str,
    settings: dict[str, Any],
    seconds: float,
    n_envs: int = 1,
    backend: str = "gymnasium",
    count: bool = False,
) -> dict[str, Any]:
    """Trains on ``n_envs`` environments, one gradient step per environment step. ``count`` counts operations too."""
    import gymnasium as gym

    settings = {**settings, "learning_starts": 100, "buffer_size": 100_000, "train_freq": 1, "gradient_steps": 1}
    agent_env: Any = gym.make(env)
    if library == "rejeu" and (n_envs > 1 or backend != "gymnasium"):
        import rejeu

        agent_env = rejeu.make_vector(env, n_envs, backend, seed=0)
    if library == "sb3":
        settings["device"] = "cpu"
    agent = common.algorithm_of(library, algorithm)("MlpPolicy", agent_env, seed=0, **settings)
    result = common.time_learning(agent, library, warm_up=WARM_UP, unit=UNIT, seconds=seconds)
    result |= common.threads_used(agent, library, n_envs)
    if count:
        from benchmarks.bench.work import flops

        result |= flops.off_policy(agent, n_envs)
    return result


if __name__ == "__main__":
    common.main(measure)
