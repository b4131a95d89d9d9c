"""Model files: everything that an agent has learnt, its hyper-parameters and its counters, and the agent of such a file."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from rejeu import spaces, xla
from rejeu.agents import loading
from rejeu.algorithms import config as configs
from rejeu.envs.registry import are_plain, is_plain_id
from rejeu.errors import CheckpointError
from rejeu.io import checkpoint

if TYPE_CHECKING:
    from rejeu.agents.base import Agent
    from rejeu.envs.make import VectorEnv

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
    "best_window": "Training episodes over whose mean return the best weights are kept; 1 keeps those of the best single "
    "episode. Raising it is surer to find a policy that is good again, as a single return may be luck.",
    "device": "Accepted for Stable-Baselines3's sake: JAX chooses the device (environment variable JAX_PLATFORMS).",
}
"""What every agent takes beside its hyper-parameters, with its meaning."""


def header(agent: Agent) -> dict[str, Any]:
    """Returns all of an agent that a model file holds beside its arrays, as JSON values."""
    run = agent.run
    return {
        "algorithm": agent.name,
        "config": configs.to_json(agent.config),
        "policy": agent.policy,
        "observation_space": spaces.describe(agent.observation_space),
        "action_space": spaces.describe(agent.action_space),
        "env_id": run.env.env_id if run.env is not None else agent._trained_on and agent._trained_on[0],
        "made_from": made_from(agent),
        "seed": agent.seed,
        "stats_window_size": agent.stats_window_size,
        "success_threshold": agent.success_threshold,
        "best_window": agent.best_window,
        "counters": {
            "step": run.step,
            "steps_before": agent._steps_before,
            "episodes_before": agent._episodes_before,
            "episode": run.episode,
            "n_updates": run.n_updates,
        },
        "rng": run.rng.bit_generator.state["state"],
    }


def made_from(agent: Agent) -> dict[str, Any] | None:
    """Returns id and keyword arguments of an agent's environments for a header, None where a file may not hold them."""
    source = agent._trained_on if agent.run.env is None else agent.run.env.made_from
    if source is None or not is_plain_id(source[0]) or not are_plain(dict(source[1])):
        return None
    return {"env_id": source[0], "env_kwargs": dict(source[1])}


def trained_on(header: Mapping[str, Any]) -> tuple[str, dict[str, Any]] | None:
    """Returns what :func:`made_from` wrote, None where there is none or where it is more than a file may say."""
    said = header.get("made_from")
    if not isinstance(said, dict) or not is_plain_id(said.get("env_id")) or not are_plain(said.get("env_kwargs")):
        return None
    return said["env_id"], said["env_kwargs"]


def find(path: str | Path) -> str | Path:
    """Returns the model of a run folder, the best one if there is one, or the path itself if it is no folder.

    Raises:
        FileNotFoundError: if a folder holds no model.
    """
    folder = Path(path)
    if not os.path.isdir(folder) or (folder.name not in ("", "..") and checkpoint.resolve(path).is_file()):
        return path
    for name in ("best", "agent"):
        if (folder / f"{name}.safetensors").is_file():
            return folder / f"{name}.safetensors"
    raise FileNotFoundError(
        f"{str(path)!r} is a folder without a model; a run folder holds best.safetensors or agent.safetensors"
    )


def load(
    cls: type[A],
    file: checkpoint.Contents,
    make_env: Callable[[A], VectorEnv | None],
    changes: dict[str, Any],
    threads: int | None = None,
    prefix: str = "",
) -> A:
    """Returns the agent that a file describes; its buffer is empty. No array is read that the agent does not have.

    Args:
        cls: the class of the agent.
        file: its header holds what :func:`header` returned.
        make_env: returns where it goes on learning, None for an agent that only predicts.
        changes: constructor arguments or hyper-parameters to set otherwise.
        threads: that JAX's device is to have; None for the number that suits the agent.
        prefix: of the names of everything learnt, in the file.

    Raises:
        CheckpointError: if something is damaged or of another algorithm or environment.
    """
    name, path, header = cls.algorithm.Config.name, file.path, file.header
    if header.get("algorithm") != name:
        other = str(header.get("algorithm"))[:40]
        raise CheckpointError(f"{path} holds a {other} agent, not {name}; use rejeu.load(path) or rejeu.{other}.load")
    own = {key: changes.pop(key) for key in [*changes] if key in AGENT_ARGUMENTS}
    given = {key: own.pop(key) for key in loading.GIVEN if key in own}
    try:
        saved = loading.interpret(header, file.room, cls.algorithm.Config, given, changes)
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from None
    agent = cls.__new__(cls)
    agent._set_up(
        saved.policy, saved.config, saved.seed, own.pop("verbose", 0), own.pop("tensorboard_log", None),
        saved.stats_window_size, saved.success_threshold, saved.best_window,
    )  # fmt: skip
    try:
        agent._build(saved.observation_space, saved.action_space)
    except loading.WRONG as error:
        raise CheckpointError(f"{path}: {loading.brief(error)}") from None
    checkpoint.match(agent.learner.shapes, checkpoint.within(file.specs, prefix), path)
    arrays = checkpoint.within(file.read(prefix), prefix)
    checkpoint.require_finite(arrays, path)
    state = checkpoint.arrays_to_tree(agent.learner.shapes, arrays, path)
    agent._trained_on = trained_on(header)
    vector = make_env(agent)
    if vector is not None:
        agent._check_spaces(vector, "the given environment")
    n_envs = 1 if vector is None else vector.n_envs
    xla.start_device(agent._threads(n_envs) if threads is None else threads)
    try:
        stand(agent, vector, state, saved)
    except (ArithmeticError, MemoryError, ValueError) as error:
        if changes.keys() & {"buffer_size", "n_steps", "n_episodes"}:
            raise
        raise CheckpointError(f"{path}: {loading.brief(error)}") from None
    return agent


def stand(agent: Agent, vector: VectorEnv | None, state: Any, saved: loading.Saved) -> None:
    """Puts a loaded agent where the saved one stood; the replay buffer is empty until one is loaded."""
    agent._start(vector, agent.learner.pack(state))
    run, counters = agent.run, saved.counters
    run.step, run.episode, run.n_updates = counters["step"], counters["episode"], counters["n_updates"]
    run.rng.bit_generator.state = {**run.rng.bit_generator.state, "state": saved.rng}
    run.learn_from = agent._learn_from(run.step)
    run.seed = int(np.random.SeedSequence([agent.seed, run.step]).generate_state(1)[0])
    agent._steps_before, agent._episodes_before = counters["steps_before"], counters["episodes_before"]
