"""Model files: everything that an agent has learned, its hyperparameters and counters, and loading them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, TypeVar

import gymnasium as gym
import msgspec
import numpy as np
from msgspec import Meta

from rejeu.algorithms import config as configs
from rejeu.checkpoints.agent_state import AGENT_ARGUMENTS, AnyAgent, Identity
from rejeu.core import checkpoint, devices, spaces, xla
from rejeu.core.errors import CheckpointError, MissingObjectError
from rejeu.core.records import WRONG, Positive, Seed, brief, convert
from rejeu.core.types import JsonObject, Settings
from rejeu.envs.make import VectorEnv
from rejeu.envs.registry import are_plain, is_plain_id

ARGUMENTS = ("policy", "seed", "stats_window_size", "success_threshold", "best_window")
"""Arguments of an agent that its model file holds."""
OUTPUTS = ("verbose", "log", "tensorboard_log")
"""Arguments that say where rows of statistics go."""

Count32 = Annotated[int, Meta(ge=0, lt=2**32)]


class Counters(msgspec.Struct):
    """The counters of a model file."""

    step: Count32
    steps_before: Count32
    episode: Count32
    n_updates: Count32
    episodes_before: Count32


class GeneratorState(msgspec.Struct):
    """The state of NumPy's PCG64."""

    state: int
    inc: int


class AgentHeader(msgspec.Struct, kw_only=True):
    """The header of a model file, which :func:`header` returns; unknown fields are ignored."""

    config: Settings
    policy: str
    observation_space: Any
    action_space: Any
    seed: Seed
    stats_window_size: Positive
    counters: Counters
    rng: GeneratorState
    success_threshold: float | None = None
    best_window: Positive


def interpret(
    header: Mapping[str, object], room: int, config_class: Any, changes: Mapping[str, object]
) -> tuple[AgentHeader, Any, gym.Space, gym.Space]:
    """Returns a header with its values checked, and of these the configuration and the two spaces.

    Args:
        header: JSON values of schema ``checkpoint.SCHEMA``.
        room: bytes that the file holds.
        config_class: that of the algorithm.
        changes: hyperparameters that the user sets otherwise than they were saved.

    Raises:
        CheckpointError: if the header is damaged, or names an object of the user's own that is not given.
        TypeError, ValueError: if ``changes`` are invalid.
    """
    try:
        saved = convert(header, AgentHeader)
        config = configs.rebuild(config_class, saved.config, configs.own_changes(saved.config, changes))
        largest = max(spaces.MAX_NUMBERS, room)
        observation_space = spaces.rebuild(saved.observation_space, largest)
        spaces.check_policy(saved.policy, observation_space, config.policy_kwargs.normalize_images)
        action_space = spaces.rebuild(saved.action_space, largest)
    except MissingObjectError:
        raise
    except WRONG as error:
        raise CheckpointError(f"the header is damaged or of another version: {brief(error)}") from None
    if changes:
        before, config = config, configs.rebuild(config_class, saved.config, changes)
        if config.action_share != before.action_share:
            raise ValueError(
                f"action_share={config.action_share} cannot replace {before.action_share}; train a new agent"
            )
    return saved, config, observation_space, action_space


def check_space(description: object, ours: gym.Space, name: str) -> None:
    """Raises ``ValueError`` unless a space of a file is the agent's, apart from the bounds of observations.

    Args:
        description: JSON values.
        ours: the agent's.
        name: ``"observation"`` or ``"action"``.
    """
    if description == spaces.describe(ours):
        return
    theirs = spaces.rebuild(description, max(spaces.MAX_NUMBERS, sum(leaf.nbytes for leaf in spaces.leaves(ours))))
    if not spaces.same(theirs, ours, bounds=name == "action"):
        raise ValueError(f"it is of the {name} space {theirs}, and this agent was made for {ours}")


A = TypeVar("A", bound=AnyAgent)


def header(agent: AnyAgent) -> JsonObject:
    """Returns the header of an agent's model file: everything except arrays, as JSON values."""
    run = agent.run
    return {
        "algorithm": agent.name,
        "config": configs.to_json(agent.config),
        "policy": agent.identity.policy_name,
        "observation_space": spaces.describe(agent.observation_space),
        "action_space": spaces.describe(agent.action_space),
        "env_id": run.env.env_id if run.env is not None else agent.identity.trained_on and agent.identity.trained_on[0],
        "made_from": made_from(agent),
        "seed": agent.identity.seed,
        "stats_window_size": agent.identity.stats_window_size,
        "success_threshold": agent.identity.success_threshold,
        "best_window": agent.identity.best_window,
        "counters": {
            "step": run.step,
            "steps_before": agent.call.reset_step,
            "episodes_before": agent.call.reset_episode,
            "episode": run.episode,
            "n_updates": run.n_updates,
        },
        "rng": run.rng.bit_generator.state["state"],
    }


def made_from(agent: AnyAgent) -> JsonObject | None:
    """Returns id and keyword arguments of an agent's environments for a header; None if a file may not hold them."""
    source = agent.origin
    if source is None or not is_plain_id(source[0]) or not are_plain(dict(source[1])):
        return None
    return {"env_id": source[0], "env_kwargs": dict(source[1])}


def trained_on(header: Mapping[str, object]) -> tuple[str, Settings] | None:
    """Returns the value of :func:`made_from` in a header; None if it is missing or not what a file may hold."""
    source = header.get("made_from")
    if not isinstance(source, dict) or not is_plain_id(source.get("env_id")) or not are_plain(source.get("env_kwargs")):
        return None
    return source["env_id"], source["env_kwargs"]


def load(
    cls: type[A],
    file: checkpoint.Contents,
    make_env: Callable[[A], VectorEnv | None],
    changes: Settings,
    threads: int | None = None,
    prefix: str = "",
) -> A:
    """Returns the agent of a file, with an empty buffer. Only arrays that the agent has are read.

    Args:
        cls: the class of the agent.
        file: its header holds what :func:`header` returned.
        make_env: returns the environment to continue training in; None for an agent that only predicts.
        changes: constructor arguments or hyperparameters that replace the saved ones.
        threads: of JAX's device; None for the number that suits the agent.
        prefix: of the names of the agent's arrays in the file.

    Raises:
        CheckpointError: if something is damaged or of another algorithm or environment.
    """
    name, path, header = cls.algorithm.Config.name, file.path, file.header
    if header.get("algorithm") != name:
        theirs = str(header.get("algorithm"))[:40]
        raise CheckpointError(f"{path} holds a {theirs} agent, not {name}; use rejeu.load(path) or rejeu.{theirs}.load")
    changes = cls.converted(changes)
    arguments = {key: changes.pop(key) for key in [*changes] if key in AGENT_ARGUMENTS}
    try:
        saved, config, observation_space, action_space = interpret(header, file.room, cls.algorithm.Config, changes)
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from None
    agent = cls.__new__(cls)
    outputs = {key: arguments.pop(key) for key in OUTPUTS if key in arguments}
    agent.configure(config, Identity.of(**{key: getattr(saved, key) for key in ARGUMENTS} | arguments))
    agent.set_outputs(**outputs)
    spaces.check_policy(agent.identity.policy_name, observation_space, config.policy_kwargs.normalize_images)
    try:
        agent.build(observation_space, action_space)
    except WRONG as error:
        raise CheckpointError(f"{path}: {brief(error)}") from None
    checkpoint.match(agent.learner.shapes, checkpoint.within(file.specs, prefix), path)
    arrays = checkpoint.within(file.read(prefix), prefix)
    checkpoint.require_finite(arrays, path)
    state = checkpoint.arrays_to_tree(agent.learner.shapes, arrays, path)
    agent.identity.trained_on = trained_on(header)
    vector = make_env(agent)
    if vector is not None:
        agent.check_spaces(vector, "the given environment")
    n_envs = 1 if vector is None else vector.n_envs
    xla.start_device(agent.n_threads(n_envs) if threads is None else threads)
    devices.find(agent.identity.device)  # an error of its own
    try:
        agent.start_run(vector, agent.learner.pack(state))
        _restore_counters(agent, saved)
    except (ArithmeticError, MemoryError, ValueError) as error:
        if changes.keys() & {"buffer_size", "n_steps", "n_episodes"}:
            raise
        raise CheckpointError(f"{path}: {brief(error)}") from None
    return agent


def _restore_counters(agent: AnyAgent, saved: AgentHeader) -> None:
    """Sets the counters and random numbers of a loaded agent; its replay buffer is empty until one is loaded."""
    run, counters = agent.run, saved.counters
    run.step, run.episode, run.n_updates = counters.step, counters.episode, counters.n_updates
    run.rng.bit_generator.state = {**run.rng.bit_generator.state, "state": msgspec.structs.asdict(saved.rng)}
    run.learn_from = agent.first_learning_step(run.step)
    run.seed = int(np.random.SeedSequence([agent.identity.seed, run.step]).generate_state(1)[0])
    agent.call.reset_step, agent.call.reset_episode = counters.steps_before, counters.episodes_before
