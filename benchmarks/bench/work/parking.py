"""Measures a complete parking run, from the first import to the last evaluation: train, save, load, evaluate."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

BEGAN = time.perf_counter()

from benchmarks.bench.work import common  # noqa: E402


def measure(library: str, backend: str, n_envs: int, settings: dict[str, Any], steps: int, episodes: int) -> dict:
    """Runs the task and returns its times.

    Timing of the training starts after ``learning_starts`` and 512 further steps, when everything is compiled. The time
    is split into the environment's ``step`` and ``reset``, measured by the same wrapper in both libraries, and the
    rest.
    """
    with tempfile.TemporaryDirectory() as folder:
        job = rejeu_job if library == "rejeu" else sb3_job
        return job(Path(folder), backend, n_envs, settings, steps, episodes)


def training_times(marks: list[tuple[float, ...]]) -> dict[str, float]:
    """Returns times per environment step from two readings of clock, steps, and time in ``step`` and ``reset``."""
    seconds, steps, in_step, in_reset = (b - a for a, b in zip(marks[0], marks[-1], strict=True))
    return {
        "training_steps_per_second": steps / seconds,
        "seconds_in_env": (in_step + in_reset) / steps,
        "seconds_outside_env": (seconds - in_step - in_reset) / steps,
        "timed_steps": steps,
    }


def rejeu_job(folder: Path, backend: str, n_envs: int, settings: dict[str, Any], steps: int, episodes: int) -> dict:
    import jax

    import rejeu
    from rejeu.core import xla

    env: Any = rejeu.make_vector("parking-v0", n_envs, backend, seed=0)
    imported = time.perf_counter()
    env.step, env.reset_done = step, reset = common.timed(env.step), common.timed(env.reset_done)
    agent = rejeu.SAC("MultiInputPolicy", env, replay_buffer_class=rejeu.HerReplayBuffer, seed=0, **settings)
    warm_up, marks, parts = settings["learning_starts"] + 512, [], []

    def mark(agent: Any, progress: Any) -> None:
        if progress.step >= (warm_up, steps)[min(len(marks), 1)] and len(marks) < 2:
            jax.block_until_ready(agent.run.state)
            marks.append((time.perf_counter(), progress.step, step.seconds, reset.seconds))
            parts.append(agent.seconds)

    agent.learn(steps, callback=mark)
    trained = time.perf_counter()
    agent.save(folder / "agent")
    agent.save_replay_buffer(folder / "buffer")
    agent = rejeu.SAC.load(folder / "agent", env=env)
    agent.load_replay_buffer(folder / "buffer")
    filed = time.perf_counter()
    evaluation = agent.evaluate(episodes, env=env)
    done = time.perf_counter()
    times = training_times(marks)
    spent = {part_name: parts[-1][part_name] - parts[0][part_name] for part_name in parts[0]}
    total = spent.pop("total")
    by_part = {part_name: value / times["timed_steps"] for part_name, value in spent.items()}
    by_part["rest"] = (total - sum(spent.values())) / times["timed_steps"]
    return times | {
        "import_seconds": imported - BEGAN,
        "train_seconds": trained - imported,
        "file_seconds": filed - trained,
        "evaluate_seconds": done - filed,
        "compile_seconds": xla.seconds(),
        "success_rate": evaluation.success_rate,
        "mean_return": evaluation.mean_return,
        "seconds_by_part": by_part,
    }


def sb3_job(folder: Path, backend: str, n_envs: int, settings: dict[str, Any], steps: int, episodes: int) -> dict:
    import gymnasium as gym
    import highway_env
    from stable_baselines3 import SAC, HerReplayBuffer
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor

    assert (backend, n_envs) == ("gymnasium", 1)
    gym.register_envs(highway_env)
    env = gym.make("parking-v0")
    imported = time.perf_counter()
    env.step, env.reset = step, reset = common.timed(env.step), common.timed(env.reset)
    agent = SAC("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, seed=0, device="cpu", **settings)
    warm_up, marks = settings["learning_starts"] + 512, []

    def mark(local_names: dict[str, Any], _: Any) -> bool:
        if local_names["self"].num_timesteps in (warm_up, steps):
            marks.append((time.perf_counter(), local_names["self"].num_timesteps, step.seconds, reset.seconds))
        return True

    agent.learn(steps, callback=mark)
    trained = time.perf_counter()
    agent.save(folder / "agent")
    agent.save_replay_buffer(folder / "buffer")
    agent = SAC.load(folder / "agent", env=env)
    agent.load_replay_buffer(folder / "buffer")
    filed = time.perf_counter()
    successes: list[float] = []

    def note(local_names: dict[str, Any], _: Any) -> None:
        if local_names["done"]:
            successes.append(float(local_names["info"]["is_success"]))

    mean_return, _ = evaluate_policy(agent, Monitor(env), episodes, deterministic=True, callback=note)
    done = time.perf_counter()
    return training_times(marks) | {
        "import_seconds": imported - BEGAN,
        "train_seconds": trained - imported,
        "file_seconds": filed - trained,
        "evaluate_seconds": done - filed,
        "compile_seconds": 0.0,
        "success_rate": sum(successes) / len(successes),
        "mean_return": float(mean_return),
        "torch_threads": common.threads_of("sb3"),
    }


if __name__ == "__main__":
    common.main(measure)
