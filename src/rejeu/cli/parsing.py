"""The parser of the command line: from words to the dataclass of a command, and help from its docstrings.

A mistake gives one line that names the fix.
"""

from __future__ import annotations

import dataclasses
import difflib
import inspect
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, NoReturn, Union, get_args, get_origin, get_type_hints

from msgspec import Meta

from rejeu.runs.config import Shown
from rejeu.runs.values import assigned
from rejeu.validation import field_docs, number, whole

OLDER = {"--film-every": "--video-every"}
"""Options of earlier versions, which are still accepted."""
ELSEWHERE = {
    "--env": "the environment is given without an option: rejeu {command} ENV",
    "--lr": "hyperparameters are given as --set learning_rate=1e-3",
    "-n": "did you mean --steps?",
    "--tensorboard": "logs are named by --log tensorboard",
    "--tensorboard-log": "logs are named by --log tensorboard",
    "--wandb": "logs are named by --log wandb",
    "--track": "logs are named by --log wandb, mlflow or trackio",
    "--n-envs": "did you mean --envs?",
    "--n-timesteps": "did you mean --steps?",
    "--total-timesteps": "did you mean --steps?",
    "--max-episode-steps": "a time limit is given where the environment is registered, or by a wrapper",
}
"""What other programs have as options, and what replaces it in ``rejeu train``, by their names."""


HYPERPARAMETERS = """
batch_size buffer_size clip_range ent_coef gae_lambda gamma gradient_steps learning_rate learning_starts max_grad_norm
n_epochs n_steps normalize optimizer policy_kwargs target_update_interval tau train_freq vf_coef
"""
"""Hyperparameters that other programs have as options."""
PARTS = {"net_arch": "[64,64]", "activation_fn": "relu"}
"""The same that are parts of ``policy_kwargs``."""


MOST = 1e300
"""The upper limit of numbers that have none."""


class Option(NamedTuple):
    """An option or a positional argument of a command."""

    field: str
    name: str
    """With its dashes; of a positional argument its metavar."""
    shown: Shown
    kind: Any
    """The type of the value: ``bool``, ``int``, ``float``, ``str``, ``Path``, ``dict``, ``tuple`` or a ``Literal``."""
    item: Any
    """The type of one word: that of the value, or of an element of a tuple."""
    limits: dict[str, float]
    """Of a number: ``ge``, ``gt`` and ``le``."""
    default: Any
    """``dataclasses.MISSING`` if it is required."""

    @property
    def takes_many(self) -> bool:
        """Whether it takes all words up to the next option; a positional argument, all further positional words."""
        return self.shown.metavar.endswith("...")


def parse(argv: Sequence[str], commands: Mapping[str, Any], about: str) -> tuple[str, Any]:
    """Returns the name of a command and its arguments.

    Args:
        argv: the words after ``rejeu``.
        commands: the dataclass of the arguments of each command.
        about: the text at the head of the help.

    Raises:
        ValueError: for an unknown command or option, with the nearest; a value that is missing, out of range, not a number
            or not among the choices; a positional argument that is missing, or one too many.
        SystemExit: when help was printed.
    """
    if not argv:
        raise ValueError("expected a command, such as rejeu train parking-v0; rejeu --help lists all")
    command, *words = argv
    if command in ("-h", "--help"):
        print_help("rejeu", about, [], {name: kind.__doc__.partition("\n")[0] for name, kind in commands.items()})
    if command not in commands:
        raise ValueError(f"no command is called {command!r}; {nearest(command, commands)}")
    kind = commands[command]
    known = [*options(kind)]
    if {"-h", "--help"} & {*words}:
        docs = field_docs(kind)
        print_help(f"rejeu {command}", kind.__doc__, known, {one.name: docs.get(one.field, "") for one in known})
    found: dict[str, Any] = {}
    for option, texts in matched(command, words, known):
        found[option.field] = with_words(option, texts, found.get(option.field))
    required = (one for one in known if one.default is dataclasses.MISSING)
    if missing := [one.name for one in required if one.field not in found]:
        raise ValueError(f"rejeu {command} needs {' and '.join(missing)}; rejeu {command} --help shows what it takes")
    return command, kind(**found)


def matched(command: str, words: Sequence[str], known: Sequence[Option]) -> Iterator[tuple[Option, list[str]]]:
    """Yields each option of a command line with its words."""
    by_name = {one.name: one for one in known if not one.shown.is_positional}
    places = [one for one in known if one.shown.is_positional]
    rest = [*words]
    while rest:
        word = rest.pop(0)
        if not word.startswith("-"):
            if not places:
                raise ValueError(
                    f"rejeu {command} does not expect {word!r}; rejeu {command} --help shows what it takes"
                )
            yield places[0], [word]
            places = places if places[0].takes_many else places[1:]
            continue
        name, equals, text = word.partition("=")
        name = OLDER.get(name.replace("_", "-"), name.replace("_", "-"))
        if name not in by_name:
            raise ValueError(f"rejeu {command} has no option {name}; {replacement(name, command, by_name)}")
        option = by_name[name]
        if option.kind is bool:
            if equals:
                raise ValueError(f"{name} takes no value, got {text!r}; leave it out or write {name} alone")
            yield option, []
            continue
        texts = [text] if equals else []
        while not equals and rest and not rest[0].startswith("--") and (option.takes_many or not texts):
            texts.append(rest.pop(0))
        if not texts:
            raise ValueError(f"{name} needs a value")
        yield option, texts


def with_words(option: Option, texts: Sequence[str], before: Any) -> Any:
    """Returns the value of an option; one that may be repeated is added to the value ``before``."""
    values = [read(option, text) for text in texts]
    if option.kind is bool:
        return True
    if option.kind is dict:
        return {**(before or {}), **assigned(values, option.name)}
    if option.kind is tuple:
        return (*(before or ()), tuple(values)) if option.item is tuple else (*(before or ()), *values)
    return values[0]


def read(option: Option, text: str) -> Any:
    """Returns the value of a word.

    Raises:
        ValueError: if it is of the wrong type or out of range.
    """
    choices = get_args(option.kind) if get_origin(option.kind) is Literal else ()
    if choices and text not in choices:
        raise ValueError(f"{option.name} {text!r} must be one of {', '.join(choices)}")
    if option.item not in (int, float):
        if text.startswith("-"):
            raise ValueError(
                f"{option.name} needs a value, got {text!r}; a path that begins with a dash is written ./{text}"
            )
        return Path(text) if option.item is Path else text
    what = "whole number" if option.item is int else "number"
    try:
        value = int(text) if text.lstrip("+-").isdecimal() else float(text)
    except ValueError:
        raise ValueError(f"{option.name} {text!r} must be a {what}") from None
    if option.item is float:
        names = {"ge": "least", "gt": "above", "le": "most"}
        return number(
            option.name, float(value), **{names[key]: limit for key, limit in option.limits.items() if limit < MOST}
        )
    if value != value // 1:
        raise ValueError(f"{option.name} {text} must be a whole number")
    return whole(option.name, int(value), int(option.limits.get("ge", 0)), int(option.limits.get("le", 2**63 - 1)))


def replacement(name: str, command: str, known: Mapping[str, Any]) -> str:
    """Returns the part of a message that says what to write instead of an unknown option."""
    if name in ELSEWHERE and "--envs" in known:
        return ELSEWHERE[name].format(command=command)
    hyperparameter = name.removeprefix("--").replace("-", "_")
    if hyperparameter in HYPERPARAMETERS.split() and "--set" in known:
        return f"hyperparameters are given as --set {hyperparameter}=VALUE"
    if hyperparameter in PARTS and "--set" in known:
        return f"hyperparameters are given as --set policy_kwargs.{hyperparameter}={PARTS[hyperparameter]}"
    return nearest(name if name.startswith("--") else f"-{name}", known)


def nearest(name: str, known: Mapping[str, Any]) -> str:
    """Returns the part of a message that names the nearest known name, or all of them."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    return f"did you mean {near[0]}?" if near else f"there are {', '.join(known)}"


def options(kind: type) -> Iterator[Option]:
    """Yields the options of a command from the dataclass of its arguments: flags, and fields with a :class:`Shown`."""
    hints = get_type_hints(kind, include_extras=True)
    for one in dataclasses.fields(kind):
        hint, marks = unmarked(hints[one.name])
        shown = Shown("") if hint is bool else next((mark for mark in marks if isinstance(mark, Shown)), None)
        if shown is None:
            continue
        if get_origin(hint) in (Union, UnionType):
            hint, inner = unmarked(get_args(hint)[0])  # None and others are no words
            marks = [*marks, *inner]
        kind_of = get_origin(hint) if get_origin(hint) in (tuple, dict) else hint
        item = get_args(hint)[0] if kind_of is tuple else hint
        numbers = [(key, getattr(mark, key)) for mark in marks if isinstance(mark, Meta) for key in ("ge", "gt", "le")]
        is_required = one.default is dataclasses.MISSING and one.default_factory is dataclasses.MISSING
        yield Option(
            field=one.name,
            name=shown.metavar if shown.is_positional else f"--{(shown.name or one.name).replace('_', '-')}",
            shown=shown,
            kind=kind_of,
            item=tuple if get_origin(item) is tuple else unmarked(item)[0],
            limits={key: limit for key, limit in numbers if limit is not None},
            default=dataclasses.MISSING if is_required else None if one.default is dataclasses.MISSING else one.default,
        )


def unmarked(hint: Any) -> tuple[Any, list[Any]]:
    """Returns a type without its annotations, and these."""
    return (get_args(hint)[0], [*get_args(hint)[1:]]) if get_origin(hint) is Annotated else (hint, [])


def print_help(program: str, about: str, known: Sequence[Option], docs: Mapping[str, str]) -> NoReturn:
    """Prints the help of a program, with a text for each of its options or commands, and exits."""
    import argparse

    parser = argparse.ArgumentParser(
        program, description=inspect.cleandoc(about), formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for one in known:
        default = one.shown.default
        if not default and isinstance(one.default, str | int | float | Path) and one.kind is not bool:
            default = f"(default: {one.default})"
        text = f"{docs[one.name]} {default}".strip().replace("%", "%%")
        if one.kind is bool:
            parser.add_argument(one.name, action="store_true", help=text)
        else:
            metavar = one.shown.metavar.removesuffix(" ...")
            many = {"nargs": "*" if one.shown.is_positional else "+"} if one.takes_many else {}
            name = one.field if one.shown.is_positional else one.name
            parser.add_argument(name, metavar=metavar, help=text, **many)  # type: ignore[arg-type]
    if not known:
        commands = parser.add_subparsers(metavar="COMMAND")
        for name, text in docs.items():
            commands.add_parser(name, help=text.replace("%", "%%"))
    parser.print_help()
    raise SystemExit(0)
