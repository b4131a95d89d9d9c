"""Interrupts and resumes runs of every algorithm and environment, and compares them with uninterrupted runs.

    python trials/resume.py --sb3-python PATH

Each case has three runs: one without interruption, one that a callback stops at a random step with a checkpoint, and
one that resumes from the checkpoint. Parameters, replay buffer or rollout, episodes, counters and rows of statistics
must be equal, bit for bit, if the state of the environment can be saved. Otherwise weights and buffer must equal those
at the interruption. With ``--sb3-python`` (an interpreter with Stable-Baselines3 2.9.2), the same is done with
Stable-Baselines3: model and replay buffer are saved and loaded, and training continues with new episodes.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import json
import random
import shlex
import subprocess
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

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


def same(one: dict[str, Any], two: dict[str, Any]) -> bool:
    import numpy as np

    return one.keys() == two.keys() and all(np.array_equal(one[key], two[key], equal_nan=True) for key in one)


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


@contextlib.contextmanager
def compiled_once() -> Iterator[None]:
    """Context in which equal agents share compiled functions (they have no state), to save compilation time."""
    from unittest import mock

    import rejeu
    from rejeu.loops.learner import Learner

    made: list[Any] = []

    def make(*arguments: Any) -> Any:
        made.extend([] if made else [Learner(*arguments)])
        return copy.copy(made[0])

    with mock.patch.object(rejeu.agents.base, "Learner", make):
        yield


def try_case(algorithm: str, env_id: str, n_envs: int, backend: str, cut: int) -> dict[str, Any]:
    import rejeu
    from rejeu.callbacks import Checkpoint

    made = make(algorithm, env_id, n_envs, backend)
    whole_rows, first, second = Rows(), Rows(), Rows()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(), compiled_once():
        warnings.simplefilter("ignore", UserWarning)
        stop = lambda agent, turn: turn.step < cut  # noqa: E731
        broken = made().learn(STEPS, [stop, Checkpoint(folder, every=300)], log_interval=1, sinks=[first])
        again = rejeu.AGENTS[algorithm].resume(folder, vector(env_id, n_envs, backend))
        exact, equal_at_break = again.resumed.exact, same(facts(again), facts(broken))
        again.learn(sinks=[second])
        whole = made().learn(STEPS, log_interval=1, sinks=[whole_rows]) if exact else None
    result = {"algorithm": algorithm, "env": env_id, "n_envs": n_envs, "backend": backend, "cut": broken.num_timesteps}
    result |= {"exact": exact, "equal_at_the_break": equal_at_break, "steps": again.num_timesteps}
    if whole is not None:
        result["equal_at_the_end"] = same(facts(again), facts(whole)) and whole_rows.rows == first.rows + second.rows
    return result


def cases() -> list[tuple[str, str, int, str]]:
    import gymnasium as gym

    import rejeu  # noqa: F401 - it registers the ball

    found = []
    for algorithm, env_ids in ALGORITHMS.items():
        for i, env_id in enumerate(env_ids):
            try:
                gym.make(env_id).close()
            except (gym.error.Error, ImportError) as error:
                print(f"{env_id} is passed over: {error}")
                continue
            found.append((algorithm, env_id, 1 if i % 2 else 2, "gymnasium"))
    return found + [(algorithm, env_id, 1, backend) for env_id, (algorithm, backend) in NOT_CARRIED.items()]


def sb3(seed: int) -> None:
    """Prints the difference of parameters between interrupted and uninterrupted runs of Stable-Baselines3."""
    import numpy as np
    import stable_baselines3

    results = []
    for algorithm, env_id in (
        ("SAC", "Pendulum-v1"),
        ("TD3", "Pendulum-v1"),
        ("DQN", "CartPole-v1"),
        ("PPO", "CartPole-v1"),
    ):
        cut = random.Random(seed).randrange(STEPS // 4, 3 * STEPS // 4)
        kind = getattr(stable_baselines3, algorithm)
        settings = {"n_steps": 64} if algorithm == "PPO" else OFF_POLICY
        make = lambda kind=kind, env_id=env_id, settings=settings: kind(  # noqa: E731
            "MlpPolicy", env_id, seed=5, **settings, policy_kwargs={"net_arch": [32, 32]}
        )
        if algorithm == "PPO":
            cut -= cut % 64  # it can only stop between rollouts
        whole = make().learn(STEPS)
        again_whole = make().learn(STEPS)
        with tempfile.TemporaryDirectory() as folder:
            first = make().learn(cut)
            first.save(f"{folder}/model")
            model = kind.load(f"{folder}/model", env=first.get_env())
            if algorithm != "PPO":
                first.save_replay_buffer(f"{folder}/replay")
                model.load_replay_buffer(f"{folder}/replay")
            model.learn(STEPS - cut, reset_num_timesteps=False)

        def apart(one: Any, two: Any) -> float:
            pairs = zip(one.policy.state_dict().values(), two.policy.state_dict().values(), strict=True)
            return max(float(np.abs(np.asarray(a) - np.asarray(b)).max()) for a, b in pairs)

        results.append(
            {
                "algorithm": algorithm,
                "env": env_id,
                "cut": cut,
                "difference_of_two_unbroken_runs": apart(whole, again_whole),
                "difference_of_the_resumed_run": apart(whole, model),
            }
        )
    print(json.dumps(results))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sb3-python")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", help="algorithms to try, instead of all")
    parser.add_argument("--sb3", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.sb3:
        sb3(arguments.seed)
        return
    rng = random.Random(arguments.seed)
    results = []
    for case in cases():
        cut = rng.randrange(120, STEPS - 60)
        if arguments.only and case[0] not in arguments.only:
            continue
        results.append(try_case(*case, cut))
        print(json.dumps(results[-1]), flush=True)
    content: dict[str, Any] = {**provenance({str(arguments.sb3_python): "PATH"}), "steps": STEPS, "cases": results}
    if arguments.sb3_python:
        done = subprocess.run(
            [arguments.sb3_python, __file__, "--sb3", "--seed", str(arguments.seed)],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        if done.returncode:
            raise SystemExit(f"{shlex.join(done.args)} failed:\n{done.stderr[-2000:]}")
        content["stable_baselines3"] = json.loads(done.stdout.strip().splitlines()[-1])
    write(RESULT, content, rows="cases")
    print(
        f"{sum(r.get('equal_at_the_end', r['equal_at_the_break']) for r in results)} of {len(results)} are as they must be"
    )


if __name__ == "__main__":
    main()
