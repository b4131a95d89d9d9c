"""Interrupts and resumes runs of every algorithm and environment, and compares them with uninterrupted runs.

    python trials/resume.py

Each case has three runs: one without interruption, one that a callback stops at a random step with a checkpoint, and
one that resumes from the checkpoint. Parameters, replay buffer or rollout, episodes, counters and rows of statistics
must be equal, bit for bit, if the state of the environment can be saved. Otherwise weights and buffer must equal those
at the interruption.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from provenance import provenance, write

RESULT = Path(__file__).parent / "results" / "resume.json"
STEPS = 1200
OFF_POLICY = {"learning_starts": 100, "batch_size": 32, "buffer_size": 700}
ON_POLICY = {"n_steps": 64}
SMALL = {"policy_kwargs": {"net_arch": [32, 32]}}
CONTINUOUS = ("Pendulum-v1", "MountainCarContinuous-v0", "rejeu/Ball-v0", "HalfCheetah-v5")
DISCRETE = ("CartPole-v1", "MountainCar-v0", "Acrobot-v1")
ALGORITHMS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("SAC", "DDPG", "TD3", "TQC", "CrossQ"), CONTINUOUS),
    **dict.fromkeys(("DQN", "QRDQN", "PQN"), DISCRETE),
    **dict.fromkeys(("PPO", "A2C", "RecurrentPPO"), (*CONTINUOUS, *DISCRETE)),
}
NOT_CARRIED = {
    "LunarLanderContinuous-v3": ("SAC", "gymnasium"),
    "CartPole-v1": ("PPO", "envpool"),
    "parking-v0": ("SAC", "gymnasium"),
}
"""Environments whose state cannot be saved, with an algorithm and a backend for each."""


def facts(agent: Any) -> dict[str, Any]:
    import numpy as np

    rows = agent.history.table()
    rows[:, 5] = 0.0  # times
    counters = np.array([agent.num_timesteps, agent.n_updates])
    buffer = {f"buffer.{key}": value for key, value in agent.run.replay.arrays().items()}
    return {**agent.get_parameters(), **buffer, "history": rows, "counters": counters}


def same(first: dict[str, Any], second: dict[str, Any]) -> bool:
    import numpy as np

    return first.keys() == second.keys() and all(
        np.array_equal(first[key], second[key], equal_nan=True) for key in first
    )


class Rows:
    """Collects rows of statistics without values that depend on wall time."""

    def __init__(self) -> None:
        self.rows: list[str] = []

    def write(self, step: int, metrics: dict[str, float]) -> None:
        self.rows.append(repr([step, *((k, v) for k, v in metrics.items() if not k.startswith("time/"))]))

    def close(self) -> None:
        """Does nothing; there are no resources to release."""


def make(algorithm: str, env_id: str, n_envs: int, backend: str) -> Callable[[], Any]:
    import rejeu

    settings: dict[str, Any] = dict(SMALL)
    if algorithm in ("PPO", "A2C", "PQN", "RecurrentPPO"):
        settings |= ON_POLICY if algorithm == "A2C" else {**ON_POLICY, "batch_size": 64}
    else:
        settings |= OFF_POLICY
    if algorithm == "DDPG":
        n = vector(env_id, 1, backend).action_space.shape[0]
        settings["action_noise"] = rejeu.OrnsteinUhlenbeckActionNoise([0.0] * n, [0.2] * n)
    nested = env_id.startswith("parking")
    policy = "MultiInputPolicy" if nested else "MlpPolicy"
    return lambda: rejeu.AGENTS[algorithm](policy, vector(env_id, n_envs, backend), seed=5, **settings)


def vector(env_id: str, n_envs: int, backend: str) -> Any:
    import rejeu

    return rejeu.make_vector(env_id, n_envs, backend, seed=3)


def try_case(algorithm: str, env_id: str, n_envs: int, backend: str, cut: int) -> dict[str, Any]:
    import rejeu
    from rejeu.callbacks import Checkpoint
    from tests.sharing import shared_learners

    make_agent = make(algorithm, env_id, n_envs, backend)
    whole_rows, first, second = Rows(), Rows(), Rows()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(), shared_learners():
        warnings.simplefilter("ignore", UserWarning)
        stop = lambda agent, turn: turn.step < cut  # noqa: E731
        broken = make_agent().learn(STEPS, [stop, Checkpoint(folder, every=300)], log_interval=1, sinks=[first])
        again = rejeu.AGENTS[algorithm].resume(folder, vector(env_id, n_envs, backend))
        exact, equal_at_break = again.resumed.exact, same(facts(again), facts(broken))
        again.learn(sinks=[second])
        whole = make_agent().learn(STEPS, log_interval=1, sinks=[whole_rows]) if exact else None
    result = {"algorithm": algorithm, "env": env_id, "n_envs": n_envs, "backend": backend, "cut": broken.num_timesteps}
    result |= {"exact": exact, "equal_at_the_break": equal_at_break, "steps": again.num_timesteps}
    if whole is not None:
        result["equal_at_the_end"] = same(facts(again), facts(whole)) and whole_rows.rows == first.rows + second.rows
    return result


def cases() -> list[tuple[str, str, int, str]]:
    import gymnasium as gym

    import rejeu  # noqa: F401 - it registers the ball

    gymnasium_cases = []
    for algorithm, env_ids in ALGORITHMS.items():
        for i, env_id in enumerate(env_ids):
            try:
                gym.make(env_id).close()
            except (gym.error.Error, ImportError) as error:
                print(f"{env_id} is passed over: {error}")
                continue
            gymnasium_cases.append((algorithm, env_id, 1 if i % 2 else 2, "gymnasium"))
    return gymnasium_cases + [(algorithm, env_id, 1, backend) for env_id, (algorithm, backend) in NOT_CARRIED.items()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", help="algorithms to try, instead of all")
    arguments = parser.parse_args()
    rng = random.Random(arguments.seed)
    results = []
    for case in cases():
        cut = rng.randrange(120, STEPS - 60)
        if arguments.only and case[0] not in arguments.only:
            continue
        results.append(try_case(*case, cut))
        print(json.dumps(results[-1]), flush=True)
    content: dict[str, Any] = {**provenance(), "steps": STEPS, "cases": results}
    write(RESULT, content, rows="cases")
    print(
        f"{sum(r.get('equal_at_the_end', r['equal_at_the_break']) for r in results)} of {len(results)} are as they must be"
    )


if __name__ == "__main__":
    main()
