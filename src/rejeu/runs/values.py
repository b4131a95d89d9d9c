"""Values as text: what follows ``--set`` and ``--env-kwargs``."""

from __future__ import annotations

import ast
import json
import os
import shlex
import subprocess
from collections.abc import Iterable, Mapping
from typing import Any

from rejeu.validation import with_value


def assigned(assignments: Iterable[str], option: str = "--set") -> dict[str, Any]:
    """Returns the values of assignments by their names, which are dotted where they reach into a nested mapping.

    Args:
        assignments: as typed.
        option: the option that they belong to, for messages.

    Raises:
        ValueError: for an assignment without ``=`` or without a name.

    >>> assigned(["policy_kwargs.net_arch=[64,64]", "gamma=0.9"])
    {'policy_kwargs.net_arch': [64, 64], 'gamma': 0.9}
    """
    result = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals or not all(name.strip().split(".")):
            example = "learning_rate=1e-3" if option == "--set" else "sigma=2"
            raise ValueError(f"{option} {assignment!r} must be name=value, such as {example}")
        result[name.strip()] = value(text)
    return result


def merged(values: Mapping[str, Any], before: Mapping[str, Any], option: str = "--set") -> dict[str, Any]:
    """Returns ``before`` with the values set; a dotted name reaches into a nested mapping.

    Raises:
        TypeError: for a dotted name that reaches into something else than a mapping.

    >>> merged({"policy_kwargs.net_arch": [64, 64], "gamma": 0.9}, {"policy_kwargs": {"layer_norm": True}})
    {'policy_kwargs': {'layer_norm': True, 'net_arch': [64, 64]}, 'gamma': 0.9}
    """
    result = dict(before)
    for name, one in values.items():
        result = with_value(result, name.split("."), one, f"{option} {name}")
    return result


def apply(assignments: Iterable[str], before: Mapping[str, Any], option: str = "--set") -> dict[str, Any]:
    """Returns ``before`` with the assignments made; see :func:`assigned` and :func:`merged`."""
    return merged(assigned(assignments, option), before, option)


def assignment_words(option: str, values: Mapping[str, Any]) -> list[str]:
    """Returns values as an option of the command line.

    >>> assignment_words("--set", {"gamma": 0.9, "policy_kwargs.net_arch": [8]})
    ['--set', 'gamma=0.9', 'policy_kwargs.net_arch=[8]']
    """
    return [option, *(f"{name}={written(value)}" for name, value in values.items())] if values else []


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


def quoted(word: object) -> str:
    """Returns a word of a command line as it is typed: in quotes where the shell needs them.

    >>> quoted("runs/first")
    'runs/first'
    """
    return subprocess.list2cmdline([str(word)]) if os.name == "nt" else shlex.quote(str(word))
