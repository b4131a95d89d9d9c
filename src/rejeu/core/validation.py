"""Checks of what users write, and the docstrings of configurations."""

from __future__ import annotations

import ast
import dataclasses
import difflib
import inspect
import itertools
import math
import numbers
import os
import sys
import textwrap
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from rejeu.core.types import Settings

C = TypeVar("C")
MOST_OUTPUTS, MOST_WIDTH, MOST_LAYERS = 10_000, 2**20, 256
MOST = {
    **dict.fromkeys(
        ("n_atoms", "n_bins", "n_cosines", "n_quantiles", "n_policy_quantiles", "n_target_quantiles"), MOST_OUTPUTS
    ),
    **dict.fromkeys(("width", "cnn_features", "lstm_hidden_size", "n_features"), MOST_WIDTH),
    **dict.fromkeys(("action_repeat", "n_critics", "n_epochs", "noise_repeat", "target_subset"), 10_000),
    **dict.fromkeys(("sequence_length", "burn_in", "n_delta", "n_eval_episodes", "n_critic_updates"), 1_000_000),
    **dict.fromkeys(("cg_max_steps", "line_search_max_iter", "sub_sampling_factor"), 1_000_000),
    "n_blocks": MOST_LAYERS,
    "frame_stack": 1_000,
}
"""Upper limits on the numbers of configurations of which something is built, so that no file can ask for more than there is:
:func:`coerce` compares them before that. Those of steps in memory are bounded by the memory, where it is reserved."""
LARGEST_VALUE = 1e30
"""Upper limit on returns; sums of products with them are finite in single precision."""


def whole(key: str, value: Any, least: int, most: int = 2**63 - 1) -> int:
    """Returns ``value`` as an int; ``1e6`` is accepted.

    Raises:
        ValueError: if it is not a whole number from ``least`` to ``most``.
    """
    is_whole = is_number(value) and value == int(value)
    if not is_whole or not least <= value <= most:
        # A limit that nobody reaches is named to those who exceed it.
        limit = f" and at most {most}" * (most < 2**62 or (is_whole and value > most))
        raise ValueError(f"{key}={value!r} must be a whole number of at least {least}{limit}")
    return int(value)


def number(key: str, value: Any, least: float = -math.inf, above: float = -math.inf, most: float = math.inf) -> float:
    """Returns ``value`` as a finite float within ``[least, most]`` and greater than ``above``.

    Raises:
        ValueError: if it is not.
    """
    if not (is_number(value) and least <= value <= most and value > above):
        bounds = [f"above {above}"] * (above > -math.inf) + [f"at least {least}"] * (least > -math.inf)
        bounds += [f"at most {most}"] * (most < math.inf)
        raise ValueError(f"{key}={value!r} must be a finite number" + (", " + " and ".join(bounds) if bounds else ""))
    return float(value)


def whole_seed(seed: object) -> int:
    """Returns a seed as an ``int``.

    Raises:
        ValueError: if it is not an integer in [0, 2^32).
    """
    if isinstance(seed, bool) or not isinstance(seed, numbers.Integral) or not 0 <= int(seed) < 2**32:
        raise ValueError(f"seed={seed!r} must be a whole number from 0 to 2**32 - 1")
    return int(seed)


def is_number(value: Any) -> bool:
    """Returns whether a value is a number that is finite as a float, and not True or False; one of 400 digits is not."""
    is_real = isinstance(value, numbers.Integral | float) and not isinstance(value, bool)
    return bool(is_real and abs(value) <= sys.float_info.max)


def flag(key: str, value: object) -> bool:
    """Returns ``value`` if it is True or False.

    Raises:
        TypeError: if it is not.
    """
    if not isinstance(value, bool):
        raise TypeError(f"{key}={value!r} must be True or False")
    return value


def without_numpy(value: Any) -> Any:
    """Returns numbers and bools of NumPy as Python's, also those in lists and tuples; anything else unchanged."""
    if type(value).__module__ == "numpy" and getattr(value, "shape", None) == ():  # which is not imported for --help
        return value.item()
    return type(value)(map(without_numpy, value)) if type(value) in (list, tuple) else value


def coerce(
    config: Any, keys: str | tuple[str, ...], converter: Callable[..., Any], optional: bool = False, **limits: Any
) -> None:
    """Replaces fields of a frozen dataclass by ``converter(key, value, **limits)``; for use in ``__post_init__``.

    Args:
        config: the dataclass under construction.
        keys: the names of the fields.
        converter: :func:`whole`, :func:`number`, :func:`flag`, or another function of that form.
        optional: whether None stays None.
        limits: passed to the converter; of numbers in :data:`MOST` the upper one is there.
    """
    for key in (keys,) if isinstance(keys, str) else keys:
        value = getattr(config, key)
        if not (optional and value is None):
            limit = {"most": MOST[key]} if converter is whole and key in MOST else {}
            assign(config, **{key: converter(key, without_numpy(value), **{**limit, **limits})})


def assign(config: Any, **values: Any) -> None:
    """Sets fields of a frozen dataclass; for use in ``__post_init__``."""
    for key, value in values.items():
        object.__setattr__(config, key, value)


def choice(key: str, value: object, among: Collection[str]) -> Any:
    """Returns ``value`` if it is one of the texts ``among``.

    Raises:
        ValueError: if it is not.
    """
    if value not in tuple(among):
        raise ValueError(f"{key}={value!r} must be one of {', '.join(among)}")
    return value


def nested(key: str, value: object, config_class: type[C]) -> C:
    """Returns a sub-configuration of class ``config_class`` from itself or from a mapping of its fields."""
    if isinstance(value, config_class):
        return value
    if value is None:
        return config_class()
    if not isinstance(value, Mapping):
        raise TypeError(f"{key}={value!r} must be a dict with the keys {', '.join(field_names(config_class))}")
    return build(config_class, value, key)


def build(cls: type[C], settings: Mapping[str, object], setting: str = "") -> C:
    """Returns ``cls(**settings)``; ``setting`` is the user's name for it, if not that of the class.

    Raises:
        TypeError: for a name that is no field, suggesting the nearest that is.
    """
    check_names(settings, field_names(cls), setting or getattr(cls, "name", "") or cls.__name__)
    return cls(**settings)


def check_names(keys: Iterable[str], names: Sequence[str], owner: str, shape: Sequence[str] = ()) -> None:
    """Raises ``TypeError`` for a name that ``owner`` does not know, suggesting the nearest, or where ``shape`` goes."""
    for key in keys:
        if key not in names:
            raise TypeError(unknown_name(key, names, owner, shape))


def with_value(mapping: Mapping[str, object], path: Sequence[str], value: object, name: str) -> Settings:
    """Returns a copy of a mapping with one value set; a path of several keys reaches into nested mappings.

    Raises:
        TypeError: if the path reaches into something else than a mapping; the message begins with ``name``.

    >>> with_value({"a": {"b": 1}}, ["a", "c"], 2, "--set a.c")
    {'a': {'b': 1, 'c': 2}}
    """
    head, *tail = path
    if not tail:
        return {**mapping, head: value}
    inner = mapping.get(head)
    inner = {} if inner is None else inner
    if not isinstance(inner, Mapping):
        raise TypeError(f"{name}: {head}={inner!r} has no parts to set")
    return {**mapping, head: with_value(inner, tail, value, name)}


def hints(table: str) -> dict[str, str]:
    """Returns where to find what goes by another name in other programs: ``"settings"`` or ``"options"``."""
    return tomllib.loads(Path(__file__).with_name("hints.toml").read_text(encoding="utf-8"))[table]


def unknown_name(key: str, names: Iterable[str], owner: str, shape: Sequence[str] = ()) -> str:
    """Returns the sentence for a misspelt name, with the nearest known one."""
    if hint := hints("settings").get(key):
        return f"{owner} has no setting {key!r}; {hint}"
    if key in shape:
        return f"{owner} takes {key} in policy_kwargs: policy_kwargs={{{key!r}: ...}}"
    return f"{owner} has no setting {key!r}; {nearest(key, names, 'known: ' + ', '.join(names))}"


def nearest(name: str, names: Iterable[str], otherwise: str = "", n: int = 1) -> str:
    """Returns the part of a message that names the ``n`` known names most like ``name``; if none is, ``otherwise``, or all.

    >>> nearest("ppo", ["PPO", "SAC"]), nearest("x", ["PPO", "SAC"])
    ('did you mean PPO?', 'there are PPO, SAC')
    """
    in_lower_case = {known_name.lower(): known_name for known_name in names}
    near = difflib.get_close_matches(name.lower(), in_lower_case, n, cutoff=0.5)
    if near:
        return f"did you mean {' or '.join(in_lower_case[key] for key in near)}?"
    return otherwise or f"there are {', '.join(in_lower_case.values())}"


def as_path(value: Any) -> Path:
    """Returns a path.

    Raises:
        TypeError: for what is none, such as None.
    """
    if not isinstance(value, str | os.PathLike):
        raise TypeError(f"{value!r} is not a path; give that of a file or folder, as text or as a pathlib.Path")
    return Path(value)


def field_names(config_class: type) -> list[str]:
    """Returns the names of a dataclass's fields, in order."""
    return [field.name for field in dataclasses.fields(config_class)]


def field_defaults(config_class: type) -> Settings:
    """Returns the default of each field of a dataclass as an instance has it; ``inspect.Parameter.empty`` if it has none."""
    fields = dataclasses.fields(config_class)
    if any(field.default is field.default_factory is dataclasses.MISSING for field in fields):
        empty = inspect.Parameter.empty
        return {field.name: empty if field.default is dataclasses.MISSING else field.default for field in fields}
    defaults = config_class()
    return {field.name: getattr(defaults, field.name) for field in fields}


def field_docs(config_class: type) -> dict[str, str]:
    """Returns the attribute docstring of each field of a dataclass, its bases' included, each on one line.

    Fields without one are left out, as are all fields of a class without source, such as one of a notebook.
    """
    docs: dict[str, str] = {}
    for owner in reversed(config_class.__mro__):
        docs.update(_attribute_docs(owner))
    return {key: docs[key] for key in field_names(config_class) if key in docs}


@cache
def _attribute_docs(owner: type) -> dict[str, str]:
    """Returns the docstrings that follow attributes in the source of a class."""
    try:
        definition = ast.parse(textwrap.dedent(inspect.getsource(owner))).body[0]
    except (OSError, TypeError, SyntaxError):
        return {}
    body = definition.body if isinstance(definition, ast.ClassDef) else []
    docs = {}
    for statement, following in itertools.pairwise(body):
        if (
            isinstance(statement, ast.AnnAssign)
            and isinstance(statement.target, ast.Name)
            and isinstance(following, ast.Expr)
            and isinstance(following.value, ast.Constant)
            and isinstance(following.value.value, str)
        ):
            docs[statement.target.id] = " ".join(following.value.value.split())
    return docs
