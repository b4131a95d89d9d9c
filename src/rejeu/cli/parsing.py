"""Checks a command line before tyro parses it, so that a mistake gives one line that names the fix."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping, Sequence
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

from tyro.conf import Positional, arg

RENAMED = {"--film-every": "--video-every"}
"""Options of earlier versions, which are still accepted."""
ELSEWHERE = {
    "--env": "the environment is given without an option: rejeu {command} ENV",
    "--lr": "hyperparameters are given as --set learning_rate=1e-3",
    "--learning-rate": "hyperparameters are given as --set learning_rate=1e-3",
    "-n": "did you mean --steps?",
}
"""What other programs have as options, and what replaces it in ``rejeu train``, by their names."""


class Option(NamedTuple):
    """An option or a positional argument of a command."""

    name: str
    """With its dashes; of a positional argument its metavar."""
    kinds: tuple[Any, ...]
    """The types of its value."""
    choices: tuple[str, ...]
    """The allowed values; empty if all are."""
    is_flag: bool
    """Whether it takes no value."""
    takes_many: bool
    """Whether it takes all words up to the next option; a positional argument, all further positional words."""
    is_positional: bool
    is_required: bool


def checked(argv: Sequence[str], commands: Mapping[str, Any]) -> list[str]:
    """Returns a command line for the parser: whole numbers such as ``1e4`` are written out.

    Raises:
        ValueError: for an unknown command or option, with the nearest; a value that is missing, not a number or not among
            the choices; a positional argument that is missing, or one too many.
    """
    if not argv:
        raise ValueError("expected a command, such as rejeu train parking-v0; rejeu --help lists all")
    command, *words = argv
    if command in ("-h", "--help"):
        return [*argv]
    if command not in commands:
        raise ValueError(f"no command is called {command!r}; {nearest(command, commands)}")
    if {"-h", "--help"} & {*words}:
        return [command, "--help"]
    known = options(commands[command])
    positionals = [one for one in known if one.is_positional]
    by_name = {one.name: one for one in known if not one.is_positional}
    result, places, received, filled, i = [], [], set[str](), 0, 0
    while i < len(words):
        word = words[i]
        i += 1
        if word.startswith("--"):
            name, equals, text = word.partition("=")
            name = name.replace("_", "-")
            name = RENAMED.get(name, name)
            if name not in by_name:
                raise ValueError(f"rejeu {command} has no option {name}; {replacement(name, command, by_name)}")
            option = by_name[name]
            if option.is_flag:
                if equals:
                    raise ValueError(f"{name} takes no value, got {text!r}; leave it out or write {name} alone")
                result.append(name)
                continue
            end = i
            while (
                not equals and end < len(words) and not words[end].startswith("--") and (option.takes_many or end == i)
            ):
                end += 1
            values = [text] if equals else words[i:end]
            if not values:
                raise ValueError(f"{name} needs a value")
            result += [name, *(read(option, value) for value in values)]
            i = end
        elif word.startswith("-"):
            raise ValueError(f"rejeu {command} has no option {word}; {replacement(word, command, by_name)}")
        elif filled == len(positionals):
            raise ValueError(f"rejeu {command} does not expect {word!r}; rejeu {command} --help shows what it takes")
        else:
            places.append(read(positionals[filled], word))
            received.add(positionals[filled].name)
            filled += not positionals[filled].takes_many
    if missing := [one.name for one in positionals if one.is_required and one.name not in received]:
        raise ValueError(f"rejeu {command} needs {' and '.join(missing)}; rejeu {command} --help shows what it takes")
    return [command, *places, *result]


def read(option: Option, text: str) -> str:
    """Returns a value for the parser.

    Raises:
        ValueError: if it is of the wrong type.
    """
    if option.choices and text not in option.choices:
        raise ValueError(f"{option.name} {text!r} must be one of {', '.join(option.choices)}")
    if not {int, float} & {*option.kinds}:
        if text.startswith("-"):
            raise ValueError(
                f"{option.name} needs a value, got {text!r}; a path that begins with a dash is written ./{text}"
            )
        return text
    what = "whole number" if int in option.kinds else "number"
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"{option.name} {text!r} must be a {what}") from None
    if int not in option.kinds:
        return repr(value)
    try:
        return str(int(text))
    except ValueError:
        if not value.is_integer():
            raise ValueError(f"{option.name} {text} must be a whole number") from None
        return str(int(value))


def replacement(name: str, command: str, known: Mapping[str, Any]) -> str:
    """Returns the part of a message that says what to write instead of an unknown option."""
    if name in ELSEWHERE and "--envs" in known:
        return ELSEWHERE[name].format(command=command)
    return nearest(name if name.startswith("--") else f"-{name}", known)


def nearest(name: str, known: Mapping[str, Any]) -> str:
    """Returns the part of a message that names the nearest known name, or all of them."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    return f"did you mean {near[0]}?" if near else f"there are {', '.join(known)}"


def options(kind: type) -> list[Option]:
    """Returns the options of a command from the dataclass of its arguments."""
    hints = get_type_hints(kind, include_extras=True)
    return [_option(one, hints[one.name]) for one in dataclasses.fields(kind)]


def _option(field: dataclasses.Field[Any], hint: Any) -> Option:
    hint, *marks = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    said: Any = next((mark for mark in marks if isinstance(mark, type(arg()))), arg())
    is_positional = any(mark is Positional for mark in marks)
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    return Option(
        name=str(said.metavar) if is_positional else f"--{said.name or field.name}".replace("_", "-"),
        kinds=kinds,
        choices=next((get_args(one) for one in kinds if get_origin(one) is Literal), ()),
        is_flag=hint is bool,
        takes_many=get_origin(hint) is tuple and (is_positional or get_origin(get_args(hint)[0]) is tuple),
        is_positional=is_positional,
        is_required=field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING,
    )
