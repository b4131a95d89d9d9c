"""Search spaces between the command line, files, Optuna and an algorithm."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rejeu.algorithms.search import Choice, Dimension, Integers, LogUniform, NearOne, Range, SearchSpace, Uniform
from rejeu.core.validation import with_value

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

KINDS: dict[str, type[Range]] = {kind.__name__: kind for kind in (Uniform, LogUniform, NearOne, Integers)}
PREFIXES: dict[str, type[Range]] = {"uniform": Uniform, "log": LogUniform, "near-one": NearOne, "int": Integers}
"""What may stand before a range on the command line."""
COMPLEMENT = "1 - "
"""Begins the name of a parameter in Optuna whose distance from 1 is sampled."""


def to_json(dimension: Dimension) -> dict[str, Any]:
    """Returns a dimension as JSON values.

    >>> to_json(Integers(1, 5))
    {'kind': 'Integers', 'low': 1, 'high': 5}
    """
    return {"kind": type(dimension).__name__, **dataclasses.asdict(dimension)}


def from_json(name: str, record: Mapping[str, Any]) -> Dimension:
    """Returns what :func:`to_json` wrote.

    Raises:
        ValueError: if the record is not one of a dimension.
    """
    kind, fields = record.get("kind"), {key: value for key, value in record.items() if key != "kind"}
    if kind == "Choice" and fields.keys() == {"values"} and isinstance(fields["values"], list | tuple):
        return Choice(tuple(fields["values"]))
    if isinstance(kind, str) and kind in KINDS and fields.keys() == {"low", "high"}:
        return KINDS[kind](**fields)
    raise ValueError(f"space.{name}={str(dict(record))[:80]} is no dimension of a search space")


def parse(assignment: str, declared: SearchSpace) -> tuple[str, Dimension]:
    """Returns name and dimension of an option such as ``learning_rate=1e-4..1e-2`` or ``batch_size=[64,128]``.

    A range is of the kind that the algorithm declares for this name. Without a declaration it is of whole numbers if both
    ends are, and otherwise uniform. ``log:``, ``uniform:``, ``int:`` and ``near-one:`` before the range say the kind.

    Raises:
        ValueError: if it is neither a range nor a list of values, or empty.

    >>> parse("gamma=0.9..0.99", {"gamma": NearOne(0.5, 0.999)})
    ('gamma', NearOne(low=0.9, high=0.99))
    >>> parse("n_steps=[128,256]", {})
    ('n_steps', Choice(values=(128, 256)))
    """
    name, equals, text = (part.strip() for part in assignment.partition("="))
    if not (name and equals):
        raise ValueError(
            f"--search {assignment!r} must be name=low..high or name=[a,b], such as learning_rate=1e-4..1e-2"
        )
    try:
        return name, _choice(text) if text.startswith("[") else _range(text, declared.get(name))
    except ValueError as error:
        raise ValueError(f"--search {name}: {error}") from None


def _choice(text: str) -> Choice:
    try:
        values = json.loads(text)
    except ValueError:
        raise ValueError(f'{text} is no list of JSON values, such as [64,128] or ["tanh","relu"]') from None
    return Choice(tuple(values))


def _range(text: str, declared: Dimension | None) -> Range:
    prefix, colon, rest = text.partition(":")
    if colon and prefix not in PREFIXES:
        raise ValueError(f"{prefix!r} is no kind of range; there are {', '.join(PREFIXES)}")
    low, dots, high = (rest if colon else text).partition("..")
    try:
        ends = [number(part) for part in (low, high)]
    except ValueError:
        fixed = "" if dots else "; --set fixes a value"
        raise ValueError(f"{text!r} must be low..high, such as 1e-4..1e-2, or a list such as [64,128]{fixed}") from None
    whole = all(isinstance(end, int) for end in ends)
    kind = (
        PREFIXES[prefix] if colon else type(declared) if isinstance(declared, Range) else Integers if whole else Uniform
    )
    return kind(*ends)


def number(text: str) -> int | float:
    """Returns the number of a text, an int where it is written as one.

    >>> number("3"), number("1e-3")
    (3, 0.001)
    """
    try:
        return int(text)
    except ValueError:
        return float(text)


def distributions(space: SearchSpace) -> dict[str, BaseDistribution]:
    """Returns Optuna's distributions of a search space, by the names of their parameters."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    found: dict[str, BaseDistribution] = {}
    for name, one in space.items():
        if isinstance(one, Choice):
            found[name] = CategoricalDistribution([label(value) for value in one.values])
        elif isinstance(one, NearOne):
            found[COMPLEMENT + name] = FloatDistribution(1 - one.high, 1 - one.low, log=True)
        elif isinstance(one, Integers):
            found[name] = IntDistribution(int(one.low), int(one.high))
        else:
            found[name] = FloatDistribution(one.low, one.high, log=isinstance(one, LogUniform))
    return found


def decoded(space: SearchSpace, params: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the values of hyperparameters from those of Optuna's parameters; unknown ones are left out."""
    values = {}
    for name, one in space.items():
        if isinstance(one, NearOne) and COMPLEMENT + name in params:
            values[name] = min(max(float(f"{1 - params[COMPLEMENT + name]:.12g}"), one.low), one.high)
        elif name in params:
            choices = {label(value): value for value in one.values} if isinstance(one, Choice) else {}
            values[name] = choices.get(params[name], params[name])
    return values


def encoded(space: SearchSpace, values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the values of Optuna's parameters for those hyperparameters whose value lies in the space."""
    params: dict[str, Any] = {}
    for name, one in space.items():
        if name not in values or not one.contains(values[name]):
            continue
        if isinstance(one, NearOne):
            params[COMPLEMENT + name] = min(max(1 - values[name], 1 - one.high), 1 - one.low)
        else:
            params[name] = label(one.values[one.index(values[name])]) if isinstance(one, Choice) else values[name]
    return params


def label(value: Any) -> str | int | float | bool | None:
    """Returns a value as a category of Optuna: itself, or its JSON text.

    >>> label([64, 64]), label("tanh")
    ('[64, 64]', 'tanh')
    """
    return value if value is None or isinstance(value, str | int | float | bool) else json.dumps(value)


def applied(hyperparameters: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns hyperparameters with some values replaced; names may be dotted. A schedule keeps its shape.

    >>> applied({"learning_rate": "lin_1e-3", "gamma": 0.9}, {"learning_rate": 0.01, "policy_kwargs.net_arch": [8]})
    {'learning_rate': 'lin_0.01', 'gamma': 0.9, 'policy_kwargs': {'net_arch': [8]}}
    """
    found = dict(hyperparameters)
    for name, value in values.items():
        found = with_value(found, name.split("."), rescaled(found.get(name), value), name)
    return found


def rescaled(old: Any, value: Any) -> Any:
    """Returns the schedule ``old`` with the starting value ``value``; just ``value`` if it is no schedule."""
    if isinstance(old, str) and old.startswith("lin_"):
        return f"lin_{value!r}"
    if isinstance(old, Mapping) and "schedule" in old and old.get("start"):
        return {**old, "start": value, "end": old.get("end", 0.0) / old["start"] * value}
    return value


def values_at(config: Mapping[str, Any], space: SearchSpace) -> dict[str, Any]:
    """Returns the values of a space's hyperparameters in a configuration as JSON, as far as it has them.

    That of a schedule is its start.
    """
    found = {}
    for name in space:
        value: Any = config
        for key in name.split("."):
            value = value.get(key) if isinstance(value, Mapping) else None
        if value is not None:
            found[name] = value["start"] if isinstance(value, Mapping) and "schedule" in value else value
    return found
