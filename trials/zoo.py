"""Compares agents that others trained, of RL Zoo's public collection, with what Stable-Baselines3 does with the same files.

Needs both libraries in one environment (stable-baselines3, sb3-contrib and rejeu), and a checkout of the collection
``DLR-RM/rl-trained-agents``::

    python trials/zoo.py actions COLLECTION              # all zip files: actions on 500 random observations
    python trials/zoo.py exports COLLECTION              # the same agents as ONNX and C
    python trials/zoo.py returns COLLECTION BENCHMARK.md # episodes, where the environment exists, beside RL Zoo's returns

Each adds to ``trials/results/zoo.json``. Of continuous actions it gives three differences, in halves of an action's range:
between the two libraries, and of either from the original's policy evaluated in float64.
"""

from __future__ import annotations

import contextlib
import pickle
import re
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import gymnasium as gym
import numpy as np
from provenance import read, write

from rejeu.agents.zoo import statistics_beside
from rejeu.envs.make import make_vector
from rejeu.sb3 import load_zip
from rejeu.sb3_contrib.common.wrappers import TimeFeatureWrapper

N = 500
RESULTS = Path(__file__).parent / "results" / "zoo.json"
PROXIES = {
    "LunarLander-v2": "LunarLander-v3",
    "LunarLanderContinuous-v2": "LunarLanderContinuous-v3",
    "Cheetah-v3": "Cheetah-v4",
    "Hopper-v3": "Hopper-v4",
    "Swimmer-v3": "Swimmer-v4",
    "Walker2d-v3": "Walker2d-v4",
}
"""Environments of today in the place of those that are gone."""


def original(path: Path) -> Any:
    """Returns the agent of a zip file in Stable-Baselines3."""
    import sb3_contrib
    import stable_baselines3

    for name in ("", ".spaces", ".spaces.box", ".spaces.dict", ".spaces.discrete", ".spaces.multi_discrete"):
        sys.modules[f"gym{name}"] = __import__(f"gymnasium{name}", fromlist=["x"])
    constant = lambda _: 0.0  # noqa: E731
    replaced = {"learning_rate": 0.0, "lr_schedule": constant, "clip_range": constant, "delta_std_schedule": constant}
    replaced |= {"replay_buffer_class": None, "replay_buffer_kwargs": {}}
    name = path.parent.parent.name.upper()
    name = "SAC" if name == "HER" else name
    algorithm = getattr(stable_baselines3, name, None) or getattr(sb3_contrib, name)
    return algorithm.load(path, custom_objects=replaced, device="cpu")


def scaler_of(path: Path) -> Any:
    """Returns the ``VecNormalize`` of a zip file as Stable-Baselines3 unpickles it; None if it has none."""
    import stable_baselines3.common.vec_env.vec_normalize  # noqa: F401

    statistics_file = statistics_beside(path)
    return None if statistics_file is None else pickle.loads(statistics_file.read_bytes())


def samples(space: gym.Space, moments: Any, rng: np.random.Generator) -> Any:
    """Returns observations that the statistics, or the bounds of a space, make likely."""
    if isinstance(space, gym.spaces.Dict):
        return {key: samples(subspace, moments and moments[key], rng) for key, subspace in space.spaces.items()}
    drawn = rng.normal(size=(N, *space.shape))
    if moments is not None:
        return (moments.mean + np.sqrt(moments.var + 1e-8) * drawn).astype(space.dtype)
    bounded = (np.abs(space.low) < 1e3) & (np.abs(space.high) < 1e3)
    low, high = np.where(bounded, space.low, 0.0), np.where(bounded, space.high, 1.0)
    return np.where(bounded, rng.uniform(low, high, drawn.shape), drawn).astype(space.dtype)


def scaled(scaler: Any, obs: Any, exact: bool) -> Any:
    """Returns observations normalized as the original does, or without its rounding to float32."""
    if scaler is None or not getattr(scaler, "norm_obs", True):
        return obs
    if not exact:
        return scaler.normalize_obs(obs)
    normalized = lambda x, m: np.clip((x - m.mean) / np.sqrt(m.var + scaler.epsilon), -scaler.clip_obs, scaler.clip_obs)  # noqa: E731
    if isinstance(obs, dict):
        return {k: normalized(x, scaler.obs_rms[k]) for k, x in obs.items()}
    return normalized(obs, scaler.obs_rms)


@contextlib.contextmanager
def in_float64(model: Any) -> Iterator[None]:
    """Evaluates a policy of the original in float64."""
    import torch

    model.policy.double()
    with mock.patch.object(torch.Tensor, "float", torch.Tensor.double):
        yield
    model.policy.float()


def joined(obs: Any, model: Any) -> Any:
    """Returns observation and goal in one array, for a policy of HER before it was a replay buffer."""
    if isinstance(obs, dict) and not isinstance(model.observation_space, gym.spaces.Dict):
        return np.concatenate([obs["observation"], obs["desired_goal"]], axis=-1)
    return obs


def compared(path: Path) -> dict[str, Any]:
    """Returns the differences between the actions of a zip file in rejeu and in Stable-Baselines3."""
    ours = load_zip(path)
    theirs, scaler = original(path), scaler_of(path)
    moments = None if scaler is None or not getattr(scaler, "norm_obs", True) else scaler.obs_rms
    space = ours.observation_space if moments is None else scaler.observation_space
    obs = samples(space, moments, np.random.default_rng(0))
    action = ours.predict(obs, deterministic=True)[0]
    expected = theirs.predict(joined(scaled(scaler, obs, exact=False), theirs), deterministic=True)[0]
    description = {"algorithm": ours.name, "normalized": moments is not None, "notes": ours.notes}
    if action.dtype.kind != "f":
        return {**description, "kind": "discrete", "differing": int((action != expected).sum())}
    with in_float64(theirs):
        exact = theirs.predict(joined(scaled(scaler, obs, exact=True), theirs), deterministic=True)[0]
    half = 0.5 * (ours.action_space.high - ours.action_space.low)
    far = lambda x, y: float((np.abs(x.astype(np.float64) - y) / half).max())  # noqa: E731
    differences = {"difference": far(action, expected), "ours": far(action, exact), "theirs": far(expected, exact)}
    return {**description, "kind": "continuous", **differences}


def exported(path: Path) -> dict[str, Any]:
    """Returns the differences of the agent of a zip file from ``predict`` as ONNX and C."""
    agent, comparisons = load_zip(path), {}
    with tempfile.TemporaryDirectory() as folder:
        for to in ("onnx", "c"):
            check = agent.export(Path(folder) / "policy", to).check
            comparisons[to] = {"difference": check.difference, "ties": check.ties, "allowed": check.allowed}
    return comparisons


def played(path: Path, published: dict[tuple[str, str], str]) -> dict[str, Any] | None:
    """Returns the returns of 20 episodes beside the published ones; None where there is no such environment."""
    env_id = path.parent.name.rpartition("_")[0]
    proxy = next((env_id.replace(old, new) for old, new in PROXIES.items() if env_id.endswith(old)), env_id)
    agent = load_zip(path)
    try:
        is_longer = agent.observation_space.shape == (gym.make(proxy).observation_space.shape[0] + 1,)
        wrap = TimeFeatureWrapper if is_longer else lambda env: env
        env = make_vector(lambda: wrap(gym.make(proxy)), 4, "gymnasium", seed=0)
        agent.check_spaces(env, "the environment")
    except (gym.error.Error, ImportError, IndexError, TypeError, ValueError) as error:
        print(error)
        return None
    with contextlib.closing(env):
        evaluation = agent.evaluate(20, env=env)
    figure = published.get((path.parent.parent.name, env_id), "")
    return {"env_id": proxy, "mean": evaluation.mean_return, "std": evaluation.std_return, "published": figure}


def main() -> None:
    """Runs one of the commands."""
    warnings.simplefilter("ignore")
    command, collection, *options = sys.argv[1:]
    results = read(RESULTS)
    published = {}
    if command == "returns":
        for row in re.findall(r"^\|\s*(\w+)\s*\|\s*([\w-]+)\s*\|\s*([^|]+?)\s*\|", Path(options[0]).read_text(), re.M):
            published[row[0], row[1]] = row[2]
    root = Path(collection)
    for path in sorted(root.glob("*/*/*.zip")):
        name, start = path.relative_to(root).as_posix(), time.time()
        try:
            inputs = (path, published) if command == "returns" else (path,)
            result: Any = {"actions": compared, "exports": exported, "returns": played}[command](*inputs)  # type: ignore[operator]
        except (AssertionError, OSError, RuntimeError, TypeError, ValueError) as error:
            result = {"error": str(error)}
        if result is not None:
            if "notes" in result:
                result["notes"] = [note.replace(f"{root}/", "") for note in result["notes"]]
            results.setdefault(name, {})[command] = result
        write(RESULTS, dict(sorted(results.items())))
        print(name, f"{time.time() - start:.1f} s", result, flush=True)


if __name__ == "__main__":
    main()
