"""Values from the command line: their ranges, ``--set name=value`` and ``--env-kwargs name=value``."""

from __future__ import annotations

import ast
import json
from collections.abc import Iterable, Mapping
from typing import Any

from rejeu.io.records import MAX_ENVS
from rejeu.validation import number, whole, with_value

MAX_EPISODES = 10_000
"""Upper limit on the episodes of an evaluation while training."""
INTEGERS = {
    "steps": (1, 2**62),
    "pause": (1, 2**63 - 1),
    "members": (2, 1000),
    "rounds": (1, 100_000),
    "round_steps": (1, 2**62),
    "envs": (1, MAX_ENVS),
    "episodes": (1, 2**63 - 1),
    "evaluate_every": (1, 2**62),
    "evaluate_episodes": (1, MAX_EPISODES),
    "video_every": (1, 2**62),
    "seed": (0, 2**32 - 1),
    "seeds": (1, 1000),
    "jobs": (1, 1000),
    "trials": (1, 100_000),
    "trial_seeds": (1, 1000),
    "final_seeds": (0, 1000),
    "workers": (1, 1000),
}
"""The smallest and the largest value of options that are whole numbers, in all commands."""


def check_values(arguments: Any) -> None:
    """Raises ``ValueError`` if a number is out of range, or if options exclude each other."""
    given = {key: value for key, value in vars(arguments).items() if value is not None}
    if {"steps", "minutes"} <= given.keys():
        raise ValueError("--steps and --minutes exclude each other; give one of them")
    if {"pause", "seeds"} <= given.keys():
        raise ValueError("--pause is for a single run; leave it out, or --seeds")
    if "jobs" in given and "seeds" not in given:
        raise ValueError("--jobs is for several seeds; give --seeds N too")
    if "backend" in vars(arguments) and given.get("backend") != "ray" and {"ray", "env_cpus"} & given.keys():
        raise ValueError("--ray and --env-cpus are for --backend ray; give it too, or leave them out")
    for key, value in given.items():
        option = f"--{key.replace('_', '-')}"
        if key in INTEGERS:
            whole(option, value, *INTEGERS[key])
        elif key == "minutes":
            number(option, value, above=0)
        elif key in ("checkpoint_minutes", "env_cpus"):
            number(option, value, least=0)
        elif key in ("success_threshold", "threshold"):
            number(option, value)


def apply(assignments: Iterable[str], before: Mapping[str, Any], option: str = "--set") -> dict[str, Any]:
    """Returns ``before`` with the assignments made; a dotted name reaches into a nested mapping.

    Args:
        assignments: as typed.
        before: values by name.
        option: the option that they belong to, for messages.

    Raises:
        ValueError: for an assignment without ``=`` or without a name.
        TypeError: for a dotted name that reaches into something else than a mapping.

    >>> apply(["policy_kwargs.net_arch=[64,64]", "gamma=0.9"], {"policy_kwargs": {"layer_norm": True}})
    {'policy_kwargs': {'layer_norm': True, 'net_arch': [64, 64]}, 'gamma': 0.9}
    """
    result = dict(before)
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        path = name.strip().split(".")
        if not equals or not all(path):
            example = "learning_rate=1e-3" if option == "--set" else "sigma=2"
            raise ValueError(f"{option} {assignment!r} must be name=value, such as {example}")
        result = with_value(result, path, value(text), f"{option} {name}")
    return result


def value(text: str) -> Any:
    """Returns the value of a text: JSON, else a Python literal, else the text itself.

    >>> [value(text) for text in ("1e-3", '[1,"episode"]', "(1, 'episode')", "False", "HerReplayBuffer")]
    [0.001, [1, 'episode'], (1, 'episode'), False, 'HerReplayBuffer']
    """
    for parse in (json.loads, ast.literal_eval):
        try:
            return parse(text)
        except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError):
            continue
    return text


def written(what: Any) -> str:
    """Returns the text from which :func:`value` reads this, if there is one.

    >>> [value(written(one)) for one in (2, "8x8", True, [1, "a"], "2")]
    [2, '8x8', True, [1, 'a'], '2']
    """
    return what if isinstance(what, str) and value(what) == what else json.dumps(what, default=str)
