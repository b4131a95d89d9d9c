"""Model files: everything that an agent has learned, its hyper-parameters and counters, and loading them."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import gymnasium as gym
import numpy as np

from rejeu import spaces, validation, xla
from rejeu.agents.policy import check_policy
from rejeu.algorithms import config as configs
from rejeu.envs.registry import are_plain, is_plain_id
from rejeu.errors import CheckpointError
from rejeu.io import checkpoint
from rejeu.networks import settled

if TYPE_CHECKING:
    from rejeu.agents.base import Agent
    from rejeu.envs.make import VectorEnv

BEST_WINDOW = 20
"""Training episodes over whose mean return the best weights are judged by default."""
COUNTERS = ("step", "steps_before", "episode", "n_updates")
"""What a model file counts; all below 2^32."""
GIVEN = ("policy", "seed", "success_threshold", "stats_window_size", "best_window")
"""Constructor arguments that a model file keeps, and that may be given otherwise when it is loaded."""
SIZES = ("n_critics", "n_quantiles")
"""Hyper-parameters outside ``policy_kwargs`` that networks grow with."""
MOST_LAYERS = 256
"""Most layers of any kind that the networks of a file may have: each costs time to build, even if it is empty."""
SMALL = 2**16
"""Widths up to here cost nothing to look at, whatever arrays a file has."""
WRONG = (ArithmeticError, AttributeError, LookupError, MemoryError, RecursionError, TypeError, ValueError)
"""What Python raises where values of a file are not what they should be."""


class Saved(NamedTuple):
    """What a model file says beside its arrays."""

    config: Any
    """The algorithm's configuration."""
    observation_space: gym.Space
    action_space: gym.Space
    counters: dict[str, int]
    rng: dict[str, int]
    """State of the NumPy generator."""
    policy: str
    seed: int
    success_threshold: float | None
    stats_window_size: int
    best_window: int


def interpret(
    header: Mapping[str, Any],
    room: int,
    kind: type,
    given: Mapping[str, Any],
    changes: Mapping[str, Any],
) -> Saved:
    """Returns what a header says, with some of it changed; builds nothing larger than the file.

    Args:
        header: JSON values of schema ``checkpoint.SCHEMA``.
        room: bytes that the file holds.
        kind: class of the algorithm's configuration.
        given: some of ``GIVEN`` as the user has them.
        changes: hyper-parameters as the user has them.

    Raises:
        CheckpointError: where the file is at fault.
        TypeError, ValueError: where ``given`` or ``changes`` are.
    """
    try:
        return _interpret({**header, **given}, room, kind, changes)
    except WRONG as error:
        own = _torso(changes)
        others = given or changes.keys() - own.keys()
        if isinstance(error, CheckpointError) or (others and _is_sound(header, room, kind, own)):
            raise
        raise CheckpointError(f"the header is damaged or of another version: {brief(error)}") from None


def _is_sound(*arguments: Any) -> bool:
    try:
        _interpret(*arguments)
    except WRONG:
        return False
    return True


def brief(error: BaseException) -> str:
    """Returns what an error says on one line, cut where it repeats values of a file at length."""
    text = " ".join((str(error) or type(error).__name__).split())
    return text if len(text) <= 400 else text[:397] + "..."


def whole_seed(seed: Any) -> int:
    """Returns a seed as an int in [0, 2^32).

    Raises:
        ValueError: otherwise.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**32:
        raise ValueError(f"seed={seed!r} must be a whole number from 0 to 2**32 - 1")
    return int(seed)


def _interpret(
    header: Mapping[str, Any],
    room: int,
    kind: type,
    changes: Mapping[str, Any],
) -> Saved:
    try:
        config: Any = configs.rebuild(kind, _with_widths(header["config"], kind), changes)
        check_sizes(config, room)
        largest = max(spaces.LARGEST, room)
        observation_space = spaces.rebuild(header["observation_space"], largest)
        threshold = header.get("success_threshold")
        policy = header["policy"]
        check_policy(policy, observation_space)
        return Saved(
            config,
            observation_space,
            spaces.rebuild(header["action_space"], largest),
            check_counters(header["counters"]),
            {key: validation.whole_exact(header["rng"][key]) for key in ("state", "inc")},
            policy,
            whole_seed(header["seed"]),
            None if threshold is None else validation.number("success_threshold", threshold),
            validation.whole("stats_window_size", header["stats_window_size"], 1),
            validation.whole("best_window", header.get("best_window", BEST_WINDOW), 1),
        )
    except KeyError as error:
        raise CheckpointError(f"the header is damaged or of another version: {brief(error)} is missing") from None


def check_counters(saved: Mapping[str, Any]) -> dict[str, int]:
    """Returns the counters of a model file; what was counted before is no more than what was counted in all.

    Raises:
        KeyError, TypeError, ValueError: if they are damaged.
    """
    counters = {key: validation.whole(key, saved[key], 0, 2**32 - 1) for key in COUNTERS}
    validation.whole("steps_before", counters["steps_before"], 0, counters["step"])
    before = saved.get("episodes_before", 0)  # older files do not have it
    return counters | {"episodes_before": validation.whole("episodes_before", before, 0, counters["episode"])}


def check_space(description: Any, own: gym.Space, kind: str) -> None:
    """Raises ``ValueError`` unless a space of a file is an agent's own: of observations in structure, of actions in bounds.

    Args:
        description: JSON values.
        own: the agent's.
        kind: ``"observation"`` or ``"action"``.
    """
    if description == spaces.describe(own):
        return
    other = spaces.rebuild(description, max(spaces.LARGEST, sum(leaf.nbytes for leaf in spaces.leaves(own))))
    if not spaces.same(other, own, bounds=kind == "action"):
        raise ValueError(f"it is of the {kind} space {other}, and this agent was made for {own}")


def _with_widths(config: Any, kind: Any) -> dict[str, Any]:
    """Returns the configuration of a file with the widths of hidden layers that it leaves to the default.

    Files say them since the default depends on the observation. In those written before, it did not.
    """
    shape = config.get("policy_kwargs")
    shape = {} if shape is None else shape
    return {**config, "policy_kwargs": {**shape, **settled(shape, kind.hidden_layers)}}


def check_sizes(config: Any, room: int) -> None:
    """Raises ``CheckpointError`` where a configuration asks for networks larger than all arrays together.

    Every layer of that width, or ensemble of that number, would have at least as many numbers. So what is built to
    compare shapes is no larger than what was read.
    """
    largest = max(SMALL, room)
    policy = config.policy_kwargs
    widths = {key: value for key, value in vars(policy).items() if isinstance(value, tuple)}
    numbers = {key: value for key, value in vars(policy).items() if type(value) is int}
    numbers |= {key: value for key, value in vars(config).items() if key in SIZES}
    for key, layers in {**widths, "n_blocks": range(policy.n_blocks)}.items():
        if len(layers) > MOST_LAYERS:
            raise CheckpointError(f"{key} has {len(layers)} layers, expected {MOST_LAYERS} at most")
    for key, value in [*numbers.items(), *((key, max(layers, default=0)) for key, layers in widths.items())]:
        if value > largest:
            raise CheckpointError(f"{key}={value} is larger than all that the file holds; it has other networks")


def _torso(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Returns of the changes only a torso, without which a file that has one cannot be judged."""
    policy = changes.get("policy_kwargs")
    if isinstance(policy, Mapping) and "torso" in policy:
        return {"policy_kwargs": {"torso": policy["torso"]}}
    return {}


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
    given = {key: own.pop(key) for key in GIVEN if key in own}
    try:
        saved = interpret(header, file.room, cls.algorithm.Config, given, changes)
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from None
    agent = cls.__new__(cls)
    agent._set_up(
        saved.policy, saved.config, saved.seed, own.pop("verbose", 0), own.pop("tensorboard_log", None),
        saved.stats_window_size, saved.success_threshold, saved.best_window,
    )  # fmt: skip
    try:
        agent._build(saved.observation_space, saved.action_space)
    except WRONG as error:
        raise CheckpointError(f"{path}: {brief(error)}") from None
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
        raise CheckpointError(f"{path}: {brief(error)}") from None
    return agent


def stand(agent: Agent, vector: VectorEnv | None, state: Any, saved: Saved) -> None:
    """Puts a loaded agent where the saved one stood; the replay buffer is empty until one is loaded."""
    agent._start(vector, agent.learner.pack(state))
    run, counters = agent.run, saved.counters
    run.step, run.episode, run.n_updates = counters["step"], counters["episode"], counters["n_updates"]
    run.rng.bit_generator.state = {**run.rng.bit_generator.state, "state": saved.rng}
    run.learn_from = agent._learn_from(run.step)
    run.seed = int(np.random.SeedSequence([agent.seed, run.step]).generate_state(1)[0])
    agent._steps_before, agent._episodes_before = counters["steps_before"], counters["episodes_before"]
