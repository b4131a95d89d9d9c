"""What the header of a model file says, checked against the size of the file before anything is built from it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from rejeu import spaces, validation
from rejeu.agents.best import BEST_WINDOW
from rejeu.agents.policies import check_policy
from rejeu.algorithms import config as configs
from rejeu.errors import CheckpointError
from rejeu.networks import settled

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
