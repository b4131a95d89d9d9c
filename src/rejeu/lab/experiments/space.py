"""Search spaces between the command line, files, Optuna and an algorithm."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rejeu.algorithms.search import Choice, Dimension, Integers, LogUniform, NearOne, Range, SearchSpace, Uniform
from rejeu.core.records import Malformed, parse_json
from rejeu.core.types import Settings
from rejeu.core.validation import with_value

if TYPE_CHECKING:
    from optuna.trial import BaseTrial

RANGES: dict[str, type[Range]] = {entry.prefix: entry for entry in (Uniform, LogUniform, NearOne, Integers)}
"""The classes of ranges by their prefixes."""
COMPLEMENT = "1 - "
"""Begins the name of a parameter in Optuna whose distance from 1 is sampled."""


def dimension_of(text: str, declared: Dimension | None = None) -> Dimension:
    """Returns the dimension of a text such as ``log:1e-4..1e-2``, ``1..5`` or ``[64,128]``; ``str`` writes it.

    A range without a prefix is of the class of the declared one. Without a declaration it is of whole numbers if both ends
    are, and otherwise uniform.

    Raises:
        ValueError: if it is neither a range nor a list of values, or empty.

    >>> str(dimension_of("1e-4..1e-2", LogUniform(1e-5, 1.0))), str(dimension_of("[64,128]"))
    ('log:0.0001..0.01', '[64, 128]')
    """
    if text.startswith("["):
        try:
            values = parse_json(text)
        except Malformed:
            raise ValueError(f'{text} is no list of JSON values, such as [64,128] or ["tanh","relu"]') from None
        return Choice(tuple(values))
    prefix, colon, ends = text.rpartition(":")
    if colon and prefix not in RANGES:
        raise ValueError(f"{prefix!r} is no kind of range; there are {', '.join(RANGES)}")
    try:
        low, high = map(number, ends.split(".."))
    except ValueError:
        hint = "" if ".." in ends else "; --set fixes a value"
        raise ValueError(f"{text!r} must be low..high, such as 1e-4..1e-2, or a list such as [64,128]{hint}") from None
    usual = Integers if isinstance(low, int) and isinstance(high, int) else Uniform
    range_class = RANGES[prefix] if colon else type(declared) if isinstance(declared, Range) else usual
    return range_class(low, high)


def parse(assignment: str, declared: SearchSpace) -> tuple[str, Dimension]:
    """Returns name and dimension of an option such as ``learning_rate=1e-4..1e-2`` or ``batch_size=[64,128]``.

    Raises:
        ValueError: as :func:`dimension_of`.

    >>> parse("gamma=0.9..0.99", {"gamma": NearOne(0.5, 0.999)})
    ('gamma', NearOne(low=0.9, high=0.99))
    """
    name, equals, text = (word.strip() for word in assignment.partition("="))
    if not (name and equals):
        raise ValueError(
            f"--search {assignment!r} must be name=low..high or name=[a,b], such as learning_rate=1e-4..1e-2"
        )
    try:
        return name, dimension_of(text, declared.get(name))
    except ValueError as error:
        raise ValueError(f"--search {name}: {error}") from None


def number(text: str) -> int | float:
    """Returns the number of a text, an int where it is written as one.

    >>> number("3"), number("1e-3")
    (3, 0.001)
    """
    try:
        return int(text)
    except ValueError:
        return float(text)


def suggested(trial: BaseTrial, space: SearchSpace) -> Settings:
    """Returns the values of a space's hyperparameters in a trial of Optuna; a new trial samples them.

    Raises:
        ValueError: if a trial that is recorded does not have all of them.
    """
    values: Settings = {}
    for name, dimension in space.items():
        if isinstance(dimension, Choice):
            labels = [label(value) for value in dimension.values]
            values[name] = dimension.values[labels.index(trial.suggest_categorical(name, labels))]
        elif isinstance(dimension, NearOne):
            low, high = 1 - dimension.high, 1 - dimension.low
            value = float(f"{1 - trial.suggest_float(COMPLEMENT + name, low, high, log=True):.12g}")
            values[name] = min(max(value, dimension.low), dimension.high)
        elif isinstance(dimension, Integers):
            values[name] = trial.suggest_int(name, int(dimension.low), int(dimension.high))
        else:
            is_log = isinstance(dimension, LogUniform)
            values[name] = trial.suggest_float(name, dimension.low, dimension.high, log=is_log)
    return values


def parameters(space: SearchSpace, config: Mapping[str, object]) -> Settings:
    """Returns Optuna's parameters for those hyperparameters of a configuration, as JSON, that lie in the space."""
    params: Settings = {}
    for name, dimension in space.items():
        value: Any = value_of(config, name)
        if not dimension.contains(value):
            continue
        if isinstance(dimension, Choice):
            params[name] = label(dimension.values[dimension.index(value)])
        elif isinstance(dimension, NearOne):
            params[COMPLEMENT + name] = min(max(1 - value, 1 - dimension.high), 1 - dimension.low)
        else:
            params[name] = value
    return params


def value_of(config: Mapping[str, object], name: str) -> object:
    """Returns the value of a dotted name in a configuration as JSON, the start of a schedule; None if there is none.

    >>> value_of({"policy_kwargs": {"net_arch": [8]}}, "policy_kwargs.net_arch")
    [8]
    """
    value: object = config
    for key in name.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    return value["start"] if isinstance(value, Mapping) and "schedule" in value else value


def label(value: object) -> str | int | float | bool | None:
    """Returns a value as a category of Optuna: itself, or its JSON text.

    >>> label([64, 64]), label("tanh")
    ('[64, 64]', 'tanh')
    """
    return value if value is None or isinstance(value, str | int | float | bool) else json.dumps(value)


def applied(hyperparameters: Mapping[str, object], values: Mapping[str, object]) -> Settings:
    """Returns hyperparameters with some values replaced; names may be dotted. A schedule keeps its shape.

    >>> applied({"learning_rate": "lin_1e-3", "gamma": 0.9}, {"learning_rate": 0.01, "policy_kwargs.net_arch": [8]})
    {'learning_rate': 'lin_0.01', 'gamma': 0.9, 'policy_kwargs': {'net_arch': [8]}}
    """
    changed = dict(hyperparameters)
    for name, value in values.items():
        changed = with_value(changed, name.split("."), rescaled(changed.get(name), value), name)
    return changed


def rescaled(old: object, value: object) -> Any:
    """Returns the schedule ``old`` with the starting value ``value``; just ``value`` if it is no schedule."""
    if isinstance(old, str) and old.startswith("lin_"):
        return f"lin_{value!r}"
    if isinstance(old, Mapping) and "schedule" in old and old.get("start"):
        return {**old, "start": value, "end": old.get("end", 0.0) / old["start"] * value}
    return value
