"""``--set name=value``: hyper-parameters from the command line."""

from __future__ import annotations

import ast
import json
from collections.abc import Iterable, Mapping
from typing import Any


def apply(assignments: Iterable[str], hyperparameters: Mapping[str, Any]) -> dict[str, Any]:
    """Returns ``hyperparameters`` with the assignments made; a dotted name reaches into a nested mapping.

    Raises:
        ValueError: for an assignment without ``=`` or without a name.
        TypeError: for a dotted name that reaches into something that is no mapping.

    >>> apply(["policy_kwargs.net_arch=[64,64]", "gamma=0.9"], {"policy_kwargs": {"layer_norm": True}})
    {'policy_kwargs': {'layer_norm': True, 'net_arch': [64, 64]}, 'gamma': 0.9}
    """
    result = dict(hyperparameters)
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        path = name.strip().split(".")
        if not equals or not all(path):
            raise ValueError(f"--set {assignment!r} must be name=value, such as learning_rate=1e-3")
        result = _put(result, path, value(text), name)
    return result


def value(text: str) -> Any:
    """Returns what a text stands for: JSON, else a Python literal, else the text itself.

    >>> [value(text) for text in ("1e-3", '[1,"episode"]', "(1, 'episode')", "False", "HerReplayBuffer")]
    [0.001, [1, 'episode'], (1, 'episode'), False, 'HerReplayBuffer']
    """
    for parse in (json.loads, ast.literal_eval):
        try:
            return parse(text)
        except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError):
            continue
    return text


def _put(mapping: Mapping[str, Any], path: list[str], new: Any, name: str) -> dict[str, Any]:
    head, *rest = path
    if not rest:
        return {**mapping, head: new}
    inner = mapping.get(head)
    inner = {} if inner is None else inner
    if not isinstance(inner, Mapping):
        raise TypeError(f"--set {name}: {head}={inner!r} has no parts to set")
    return {**mapping, head: _put(inner, rest, new, name)}
