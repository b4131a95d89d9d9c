"""Model files: everything that an agent has learnt, its hyper-parameters and its counters, and the agent of such a file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from rejeu import checkpoint, config as configs, spaces
from rejeu.errors import CheckpointError

if TYPE_CHECKING:
    from rejeu.agents.base import Agent
    from rejeu.envs.vector import VectorEnv

A = TypeVar("A", bound="Agent")

AGENT_ARGUMENTS = {
    "policy": "``MlpPolicy``, ``MultiInputPolicy`` (Dict observations) or ``CnnPolicy`` (images). All three build what "
    "the observation space needs; a name that does not fit the space is an error.",
    "env": "An id, a Gymnasium environment, a function that makes one, or a vector environment.",
    "seed": "Seeds everything: networks, exploration, batches and environments. None draws one.",
    "verbose": "0 is silent, 1 prints a table of statistics every ``log_interval`` episodes.",
    "tensorboard_log": "Folder for TensorBoard logs, None for none.",
    "stats_window_size": "Episodes over which reported means are taken.",
    "success_threshold": "Return from which on an episode counts as a success where the environment does not say; None: "
    "the environment's own reward threshold, if it has one.",
    "device": "Accepted for Stable-Baselines3's sake: JAX chooses the device (environment variable JAX_PLATFORMS).",
}
"""What every agent takes beside its hyper-parameters, with its meaning."""
COUNTERS = ("step", "steps_before", "episode", "n_updates")
"""What a model file counts; all below 2^32."""


def header(agent: Agent) -> dict[str, Any]:
    """Returns all of an agent that a model file holds beside its arrays, as JSON values."""
    run = agent._run
    return {
        "algorithm": agent.name,
        "config": configs.to_json(agent.config),
        "policy": agent.policy,
        "observation_space": spaces.describe(agent.observation_space),
        "action_space": spaces.describe(agent.action_space),
        "env_id": run.env.env_id if run.env is not None else None,
        "seed": agent.seed,
        "stats_window_size": agent.stats_window_size,
        "success_threshold": agent.success_threshold,
        "counters": {
            "step": run.step,
            "steps_before": agent._steps_before,
            "episode": run.episode,
            "n_updates": run.n_updates,
        },
        "rng": run.rng.bit_generator.state["state"],
    }


def load(
    cls: type[A],
    path: str | Path,
    header: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    make_env: Callable[[A], VectorEnv | None],
    changes: dict[str, Any],
) -> A:
    """Returns the agent that a header and the arrays of its state describe; its buffer is empty.

    Args:
        cls: the class of the agent.
        path: where they are from, for messages.
        header: what :func:`header` returned.
        arrays: everything learnt, by name.
        make_env: returns where it goes on learning, None for an agent that only predicts.
        changes: constructor arguments or hyper-parameters to set otherwise.

    Raises:
        CheckpointError: if something is damaged or of another algorithm or environment.
    """
    name = cls.algorithm.Config.name
    if header.get("algorithm") != name:
        other = str(header.get("algorithm"))[:40]
        raise CheckpointError(f"{path} holds a {other} agent, not {name}; use rejeu.load(path) or rejeu.{other}.load")
    own = {key: changes.pop(key) for key in [*changes] if key in AGENT_ARGUMENTS}
    try:
        config = configs.rebuild(cls.algorithm.Config, header["config"], changes)
        observation_space = spaces.rebuild(header["observation_space"])
        action_space = spaces.rebuild(header["action_space"])
        counters = {key: configs.whole(key, header["counters"][key], 0, 2**32 - 1) for key in COUNTERS}
        rng = {key: configs.whole_exact(header["rng"][key]) for key in ("state", "inc")}
        seed = whole_seed(own.pop("seed", header["seed"]))
        threshold = own.pop("success_threshold", header.get("success_threshold"))
        threshold = None if threshold is None else configs.number("success_threshold", threshold)
        window = configs.whole("stats_window_size", own.pop("stats_window_size", header["stats_window_size"]), 1)
        policy = own.pop("policy", header["policy"])
        cls._check_policy(policy, observation_space)
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        if changes and not isinstance(error, KeyError):
            raise
        raise CheckpointError(f"{path}: the header is damaged or of another version: {error}") from None

    agent = cls.__new__(cls)
    agent._set_up(
        policy, config, seed, own.pop("verbose", 0), own.pop("tensorboard_log", None), window, threshold
    )  # fmt: skip
    try:
        agent._build(observation_space, action_space, 1)
    except (TypeError, ValueError, MemoryError, OverflowError) as error:
        raise CheckpointError(f"{path}: {error}") from None
    state = checkpoint.arrays_to_tree(agent._compiled.shapes, arrays, path)
    vector = make_env(agent)
    if vector is not None:
        agent._check_spaces(vector, "the given environment")
    agent._stand(vector, state, counters, rng)
    return agent


def whole_seed(seed: Any) -> int:
    """Returns a seed as an int in [0, 2^32).

    Raises:
        ValueError: otherwise.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**32:
        raise ValueError(f"seed={seed!r} must be a whole number from 0 to 2**32 - 1")
    return int(seed)
