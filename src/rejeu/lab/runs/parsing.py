"""The parser of the command line: one of ``argparse`` for each command, made from the dataclass of its arguments.

A mistake gives one line that names the fix.
"""

from __future__ import annotations

import argparse
import inspect
import shutil
import textwrap
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from decimal import Decimal
from pathlib import Path
from typing import Any, Literal, NoReturn, get_args, get_origin

from rejeu.core.types import Settings
from rejeu.core.validation import field_docs, hints, nearest, number, whole
from rejeu.lab.runs.config import Option, Topic, assigned, options

HYPERPARAMETERS = """
batch_size buffer_size clip_range ent_coef gae_lambda gamma gradient_steps learning_rate learning_starts max_grad_norm
n_epochs n_steps normalize optimizer policy_kwargs target_update_interval tau train_freq vf_coef
"""
"""Hyperparameters that other programs have as options."""
PARTS = {"net_arch": "[64,64]", "activation_fn": "relu"}
"""Entries of ``policy_kwargs`` that other programs have as options, each with an example."""


DASHED = "{name} needs a value, got {text!r}; a path that begins with a dash is written ./{text}"
MOST = 1e300
"""The upper limit of numbers that have none."""


MOST_IN_ONE_LIST = 12
"""Number of options above which the help of a command lists them in groups."""


class Refused(Exception):
    """A value is not one of its option; not a ``ValueError``, which ``argparse`` would put into a sentence of its own."""


class Parser(argparse.ArgumentParser):
    """Raises an error where ``argparse`` prints one and exits."""

    def error(self, message: str) -> NoReturn:
        raise argparse.ArgumentError(None, message)


def parse(
    argv: Sequence[str], commands: Mapping[str, Any], tasks: Mapping[str, Iterable[Any]], description: str
) -> tuple[str, Any]:
    """Returns the name of a command and its arguments.

    Args:
        argv: the words after ``rejeu``.
        commands: the dataclass of the arguments of each command.
        tasks: these dataclasses, by what people want to do.
        description: the text at the head of the help.

    Raises:
        ValueError: for an unknown command or option, with the nearest; a value that is missing, out of range, not a number
            or not among the choices; a positional argument that is missing, or one too many.
        SystemExit: when help was printed.
    """
    if not argv:
        raise ValueError("expected a command, such as rejeu train parking-v0; rejeu --help lists all")
    command, *words = argv
    if command in ("-h", "--help"):
        overview(tasks, description).parse_args([command])
    if command not in commands:
        raise ValueError(f"no command is called {command!r}; {nearest(command, commands)}")
    declared = {option.name: option for option in options(commands[command])}
    parser = make_parser(command, commands[command], declared.values(), {"-h", "--help"} & {*words})
    try:
        typed, leftover = parser.parse_known_intermixed_args([normalized(word) for word in words])
    except Refused as error:
        raise ValueError(str(error)) from None
    except argparse.ArgumentError as error:
        raise ValueError(problem(declared[error.argument_name or ""], words)) from None
    if unknown := next((word for word in leftover if word.startswith("-")), ""):
        name = unknown.partition("=")[0]
        flags = {key: option for key, option in declared.items() if not option.shown.is_positional}
        raise ValueError(f"rejeu {command} has no option {name}; {replacement(name, command, flags)}")
    if leftover:
        raise ValueError(f"rejeu {command} does not expect {leftover[0]!r}; rejeu {command} --help shows what it takes")
    fields = {option.field: option for option in declared.values()}
    present = {name: value for name, value in vars(typed).items() if value not in (None, [])}
    if missing := [
        option.name.removesuffix(" ...")
        for name, option in fields.items()
        if option.is_required and name not in present
    ]:
        raise ValueError(f"rejeu {command} needs {' and '.join(missing)}; rejeu {command} --help shows what it takes")
    values = {name: collected(fields[name], value) for name, value in present.items()}
    return command, commands[command](**values)


def overview(tasks: Mapping[str, Iterable[Any]], description: str) -> argparse.ArgumentParser:
    """Returns the parser whose help lists the commands."""
    usage = "rejeu COMMAND ...\n       rejeu COMMAND --help"
    parser = Parser("rejeu", usage, description, formatter_class=argparse.RawDescriptionHelpFormatter)
    for task, schemas in tasks.items():
        listed = parser.add_argument_group(task)
        for schema in schemas:
            listed.add_argument(schema.__name__.lower(), help=schema.__doc__.partition("\n")[0].replace("%", "%%"))
    return parser


def make_parser(command: str, schema: type, declared: Iterable[Option], with_help: object) -> argparse.ArgumentParser:
    """Returns the parser of a command, by default without help texts. What is not given is no attribute of its result.

    The options of a command that has many are listed in groups.
    """
    declared = tuple(declared)
    words = [entry.name if entry.is_required else f"[{entry.name}]" for entry in declared if entry.shown.is_positional]
    parser = Parser(
        f"rejeu {command}",
        " ".join(["rejeu", command, *words, "[options]"]),
        description=filled(inspect.cleandoc(schema.__doc__ or "")) if with_help else None,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        argument_default=argparse.SUPPRESS,
        allow_abbrev=False,
        exit_on_error=False,
    )
    docs = field_docs(schema) if with_help else {}
    lists: dict[Topic, Any] = dict.fromkeys(Topic, parser)
    if len(declared) > MOST_IN_ONE_LIST:
        lists |= {topic: parser.add_argument_group(topic) for topic in Topic if topic is not Topic.FIRST}
    for option in declared:
        text = docs.get(option.field, option.shown.help).replace("%", "%%")
        if option.type is bool:
            lists[option.group].add_argument(option.name, dest=option.field, action="store_true", help=text)
            continue
        if isinstance(default := option.default, str | int | float | Path):
            text += f" (default: {default:g})" if isinstance(default, float) else f" (default: {default})"
        metavar = option.shown.metavar.removesuffix(" ...")
        settings: Settings = {"metavar": metavar, "help": text, "type": reader(option)}
        if option.takes_many:
            settings["nargs"] = "*" if option.shown.is_positional else "+"
        elif option.shown.is_positional:
            settings |= {"nargs": "?", "default": None}
        if option.shown.is_positional:
            parser.add_argument(option.field, **settings)
        else:
            action = {dict: "extend", tuple: "extend" if option.takes_many else "append"}.get(option.type, "store")
            lists[option.group].add_argument(option.name, dest=option.field, action=action, **settings)
    return parser


def filled(text: str) -> str:
    """Returns paragraphs as wide as the terminal."""
    width = shutil.get_terminal_size().columns - 2
    return "\n\n".join(textwrap.fill(paragraph, width) for paragraph in text.split("\n\n"))


def normalized(word: str) -> str:
    """Returns a word as ``argparse`` reads it: options with dashes, and numbers without exponents.

    >>> [normalized(word) for word in ("--evaluate_every=5", "-1e3", "-1e-5", "a_b")]
    ['--evaluate-every=5', '-1000.0', '-0.00001', 'a_b']
    """
    if word.startswith("--"):
        name, equals, text = word.partition("=")
        return name.replace("_", "-") + equals + text
    if word.startswith("-"):
        with suppress(ValueError):
            return f"{int(word)}" if word[1:].isdecimal() else f"{Decimal(repr(float(word))):f}"
    return word


def problem(option: Option, words: Sequence[str]) -> str:
    """Returns the line about an option that has a value and takes none, or has none and needs one."""
    name = option.name
    if option.type is bool:
        value = next(word.partition("=")[2] for word in map(normalized, words) if word.startswith(f"{name}="))
        return f"{name} takes no value, got {value!r}; leave it out or write {name} alone"
    position = next((i for i, word in enumerate(words) if normalized(word) == name), len(words))
    following = next(iter(words[position + 1 :]), "--")
    if following.startswith("--"):
        return f"{name} needs a value"
    return DASHED.format(name=name, text=following)


def reader(option: Option) -> Callable[[str], Any]:
    """Returns the function that reads a word of an option; what it raises becomes the message as it is."""

    def convert(text: str) -> Any:
        try:
            return read(option, text)
        except ValueError as error:
            raise Refused(str(error)) from None

    return convert


def read(option: Option, text: str) -> Any:
    """Returns the value of a word.

    Raises:
        ValueError: if it is of the wrong type or out of range.
    """
    if get_origin(option.type) is Literal and text not in get_args(option.type):
        raise ValueError(f"{option.name} {text!r} must be one of {', '.join(get_args(option.type))}")
    if option.item not in (int, float):
        if text.startswith("-"):
            raise ValueError(DASHED.format(name=option.name, text=text))
        return Path(text) if option.item is Path else text
    expected = "whole number" if option.item is int else "number"
    try:
        value = int(text) if text.lstrip("+-").isdecimal() else float(text)
    except ValueError:
        raise ValueError(f"{option.name} {text!r} must be a {expected}") from None
    if option.item is float:
        names = {"ge": "least", "gt": "above", "le": "most"}
        limits = {names[key]: limit for key, limit in option.limits.items() if limit < MOST}
        return number(option.name, float(value), **limits)
    if value != value // 1:
        raise ValueError(f"{option.name} {text} must be a whole number")
    return whole(option.name, int(value), int(option.limits.get("ge", 0)), int(option.limits.get("le", 2**63 - 1)))


def collected(option: Option, typed: Any) -> Any:
    """Returns the value of an option that was given: of one that may be repeated, that of all its words."""
    return assigned(typed, option.name) if option.type is dict else tuple(typed) if option.type is tuple else typed


def replacement(name: str, command: str, options: Collection[str]) -> str:
    """Returns the part of a message that says what to write instead of an unknown option."""
    if "--envs" in options and (hint := hints("options").get(name)):
        return hint.format(command=command)
    hyperparameter = name.removeprefix("--").replace("-", "_")
    if hyperparameter in HYPERPARAMETERS.split() and "--set" in options:
        return f"hyperparameters are given as --set {hyperparameter}=VALUE"
    if hyperparameter in PARTS and "--set" in options:
        return f"hyperparameters are given as --set policy_kwargs.{hyperparameter}={PARTS[hyperparameter]}"
    return nearest(name if name.startswith("--") else f"-{name}", options)
