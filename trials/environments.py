"""Trains in valid and invalid environments of many kinds and checks the outcomes.

    python trials/environments.py

PPO trains in every environment of ``trials/environment_kinds.py`` for 240 steps with a checkpoint every 100 steps. SAC
does the same if it supports the action space. Every run must have the expected outcome. It can complete all steps with
finite weights. It can raise ``BadEnvironmentError``, whose message must name the environment and the fault. It can
raise the environment's own exception, or be rejected when the agent is created. After an exception there must be a
checkpoint of the last step that loads and has finite weights. Further environments break worker processes: the
exception must report this, and no process may remain.

Each run has a timeout of one minute. ``trials/results/environments.json`` contains totals and every run with an
unexpected outcome.
"""

from __future__ import annotations

import collections
import contextlib
import io
import json
import os
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")  # compilation takes most of the time

import numpy as np
import psutil
from gymnasium import spaces
from provenance import provenance, write

import rejeu
from rejeu.callbacks import Checkpoint
from rejeu.runs.folder import run_files
from trials.environment_kinds import ENDS, RAISES, REFUSED, TRAINS, WORKERS, Kind, kinds

RESULT = Path(__file__).parent / "results" / "environments.json"
STEPS, EVERY_STEPS, SECONDS = 240, 100, 60
SETTINGS: dict[str, dict[str, Any]] = {
    "PPO": {"n_steps": 32, "batch_size": 32, "n_epochs": 1},
    "SAC": {"learning_starts": 20, "batch_size": 8, "buffer_size": 500, "train_freq": 8},
}
OURS = (rejeu.errors.BadEnvironmentError, rejeu.errors.WorkerError)


class TooLongError(BaseException):
    """Raised when a run exceeds its time limit."""


@contextlib.contextmanager
def bounded(seconds: float) -> Iterator[None]:
    """Raises ``TooLongError`` after a number of seconds."""

    def late(number: int, frame: Any) -> None:
        raise TooLongError

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def policy_of(space: spaces.Space) -> str:
    return "MultiInputPolicy" if isinstance(space, spaces.Dict | spaces.Tuple) else "MlpPolicy"


def outcome(error: BaseException | None, began: bool) -> str:
    """Returns the outcome of a run: one of the four of :mod:`trials.environment_kinds`, or an invalid one."""
    if error is None:
        return TRAINS
    if isinstance(error, OURS):
        return ENDS
    if isinstance(error, TooLongError):
        return "took too long"
    return REFUSED if not began and isinstance(error, TypeError | ValueError) else RAISES


def is_sound(agent: rejeu.Agent) -> bool:
    return all(np.isfinite(array).all() for array in agent.get_parameters().values() if array.dtype.kind == "f")


def checkpoint_of(agent: rejeu.Agent, folder: Path, kind: Kind) -> str:
    """Returns the fault of the checkpoint saved after an exception, empty if there is none."""
    files = run_files(folder)
    if not files:
        return "there is no checkpoint"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        resumed = type(agent).resume(folder, kind.make())
    if resumed.resumed is None or resumed.resumed.step != agent.num_timesteps:
        return f"it is of step {resumed.resumed and resumed.resumed.step} and the run ended at {agent.num_timesteps}"
    return "" if is_sound(resumed) else "its weights are not finite"


def attempt(kind: Kind, algorithm: str, folder: Path) -> dict[str, Any]:
    """Trains once and returns the outcome."""
    agent, error, began = None, None, time.perf_counter()
    try:
        with bounded(SECONDS), contextlib.redirect_stderr(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            env = kind.make()
            shape = {"policy_kwargs": {"net_arch": [8]}, "seed": 0}
            make = rejeu.AGENTS[algorithm]
            agent = make(policy_of(env.observation_space), env, **shape, **SETTINGS[algorithm])
            agent.learn(STEPS, Checkpoint(folder, every=EVERY_STEPS))
    except BaseException as caught:
        error = caught
    found: dict[str, Any] = {"outcome": outcome(error, agent is not None), "error": said(error)}
    found["seconds"] = round(time.perf_counter() - began, 1)
    found["wrong"] = wrong(found, error, agent, kind, folder)
    return found


def said(error: BaseException | None) -> str:
    return "" if error is None else f"{type(error).__name__}: {error}".replace("\n", " ")[:300]


def wrong(
    found: dict[str, Any], error: BaseException | None, agent: rejeu.Agent | None, kind: Kind, folder: Path
) -> list[str]:
    """Returns the differences between a run and its expected outcome."""
    faults = []
    if found["outcome"] != kind.must:
        faults.append(f"{found['outcome']}, and must be: {kind.must}")
    if kind.error and error is not None and type(error).__name__ != kind.error:
        faults.append(f"{type(error).__name__}, and must be: {kind.error}")
    if agent is None:
        return faults
    if error is None and agent.num_timesteps != STEPS:
        faults.append(f"{agent.num_timesteps} of {STEPS} steps were taken")
    if not is_sound(agent):
        faults.append("weights are not finite")
    if found["outcome"] == ENDS and type(agent.env.envs[0].unwrapped).__name__ not in str(error):
        faults.append("the error does not name the environment")
    if isinstance(error, Exception) and not isinstance(error, rejeu.errors.NonFiniteError):
        faults.extend(filter(None, [checkpoint_of(agent, folder, kind)]))
    return faults


def fitting(kind: Kind) -> list[str]:
    """Returns the algorithms to run: PPO, and SAC if it supports the action space."""
    try:
        space: Any = kind.make().action_space
    except OSError:
        return ["PPO", "SAC"]
    return ["PPO"] if isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary) else ["PPO", "SAC"]


def in_process() -> list[dict[str, Any]]:
    found = []
    for name, kind in kinds().items():
        for algorithm in fitting(kind):
            kind = kind._replace(must=kind.sac or kind.must) if algorithm == "SAC" else kind
            with tempfile.TemporaryDirectory() as folder:
                one = {
                    "kind": name,
                    "algorithm": algorithm,
                    "must": kind.must,
                    **attempt(kind, algorithm, Path(folder)),
                }
            found.append(one)
            print(len(found), json.dumps(one), flush=True)
    return found


def in_workers() -> list[dict[str, Any]]:
    """Trains SAC in two worker processes of each environment, and returns the processes that remain afterwards."""
    found, process = [], psutil.Process()
    for name, (make, must) in WORKERS.items():
        error, agent, vector, began = None, None, None, time.perf_counter()
        before = {child.pid for child in process.children(recursive=True)}
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                with bounded(SECONDS):
                    vector = rejeu.make_vector(make, 2, "gymnasium-async", seed=0, worker_timeout=5.0)
                    agent = rejeu.SAC("MlpPolicy", vector, seed=0, policy_kwargs={"net_arch": [8]}, **SETTINGS["SAC"])
                    agent.learn(STEPS, Checkpoint(folder, every=EVERY_STEPS))
            except BaseException as caught:
                error = caught
            faults = [] if outcome(error, True) == must else [f"{outcome(error, True)}, and must be: {must}"]
            if agent is not None and error is not None:
                faults.extend(filter(None, [checkpoint_of(agent, Path(folder), Kind(two_good, must))]))
            if vector is not None:
                vector.close()
            left = [child for child in process.children(recursive=True) if child.pid not in before and is_worker(child)]
            faults += [f"{len(left)} processes were left"] * bool(left)
        one = {"kind": name, "must": must, "outcome": outcome(error, True), "error": said(error), "wrong": faults}
        one["seconds"] = round(time.perf_counter() - began, 1)
        found.append(one)
        print(len(found), json.dumps(one), flush=True)
    return found


def two_good() -> Any:
    from trials.environment_kinds import Good

    return rejeu.make_vector(Good, 2, "gymnasium")


def is_worker(process: psutil.Process) -> bool:
    """Returns whether a process runs an environment, as opposed to a helper process of ``multiprocessing``."""
    with contextlib.suppress(psutil.Error):
        command = " ".join(process.cmdline())
        return "resource_tracker" not in command and "forkserver" not in command
    return False


def restarted() -> dict[str, Any]:
    """Trains in workers that are killed repeatedly and restarted, and returns the number of steps taken."""
    from trials.environment_kinds import killed

    vector = rejeu.make_vector(killed, 2, "gymnasium-async", seed=0, restart_workers=40)
    agent = rejeu.SAC("MlpPolicy", vector, seed=0, policy_kwargs={"net_arch": [8]}, **SETTINGS["SAC"])
    with warnings.catch_warnings(record=True) as said_so:
        warnings.simplefilter("always")
        agent.learn(4 * STEPS)
    vector.close()
    times = sum("start" in str(one.message) for one in said_so)
    return {"steps asked for": 4 * STEPS, "steps taken": agent.num_timesteps, "workers started again": times}


def main() -> None:
    began = time.perf_counter()
    parts = {"in this process": in_process(), "in worker processes": in_workers()}
    result: dict[str, Any] = {**provenance(), "minutes": round((time.perf_counter() - began) / 60, 1)}
    for name, runs in parts.items():
        result[name] = {
            "kinds": len({one["kind"] for one in runs}),
            "runs": len(runs),
            "as they must be": sum(not one["wrong"] for one in runs),
            "outcomes": dict(collections.Counter(one["outcome"] for one in runs)),
            "longest seconds": max(one["seconds"] for one in runs),
            "not as they must be": [one for one in runs if one["wrong"]],
        }
    result["restarted workers"] = restarted()
    write(RESULT, result)
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
