"""The parser of the command line: one of ``argparse`` for each command, made from the dataclass of its arguments.

A mistake gives one line that names the fix.
"""

from __future__ import annotations

import argparse
import difflib
import inspect
import shutil
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from decimal import Decimal
from pathlib import Path
from typing import Any, Literal, NoReturn, get_args, get_origin

from rejeu.core.validation import field_docs, number, whole
from rejeu.lab.runs.config import Option, Topic, assigned, options

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


DASHED = "{name} needs a value, got {text!r}; a path that begins with a dash is written ./{text}"
MOST = 1e300
"""The upper limit of numbers that have none."""


MOST_IN_ONE_LIST = 12
"""Number of options above which the help of a command lists them in groups."""


class Parser(argparse.ArgumentParser):
    """Raises an error where ``argparse`` prints one and exits."""

    def error(self, message: str) -> NoReturn:
        raise argparse.ArgumentError(None, message)


def parse(
    argv: Sequence[str], commands: Mapping[str, Any], tasks: Mapping[str, Iterable[Any]], about: str
) -> tuple[str, Any]:
    """Returns the name of a command and its arguments.

    Args:
        argv: the words after ``rejeu``.
        commands: the dataclass of the arguments of each command.
        tasks: the same, by what people want to do.
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
        overview(tasks, about).parse_args([command])
    if command not in commands:
        raise ValueError(f"no command is called {command!r}; {nearest(command, commands)}")
    known = {one.name: one for one in options(commands[command])}
    parser = make_parser(command, commands[command], known.values(), {"-h", "--help"} & {*words})
    try:
        typed, rest = parser.parse_known_intermixed_args([normalized(word) for word in words])
    except argparse.ArgumentError as error:
        raise ValueError(problem(error, command, words)) from None
    if unknown := next((word for word in rest if word.startswith("-")), ""):
        name = unknown.partition("=")[0]
        named = {key: one for key, one in known.items() if not one.shown.is_positional}
        raise ValueError(f"rejeu {command} has no option {name}; {replacement(name, command, named)}")
    if rest:
        raise ValueError(f"rejeu {command} does not expect {rest[0]!r}; rejeu {command} --help shows what it takes")
    values = {name: value for name, value in vars(typed).items() if value is not None}
    chosen = {one.field: collected(one, values[one.field]) for one in known.values() if one.field in values}
    return command, commands[command](**chosen)


def overview(tasks: Mapping[str, Iterable[Any]], about: str) -> argparse.ArgumentParser:
    """Returns the parser whose help lists the commands."""
    usage = "rejeu COMMAND ...\n       rejeu COMMAND --help"
    parser = Parser("rejeu", usage, about, formatter_class=argparse.RawDescriptionHelpFormatter)
    for task, kinds in tasks.items():
        listed = parser.add_argument_group(task)
        for kind in kinds:
            listed.add_argument(kind.__name__.lower(), help=kind.__doc__.partition("\n")[0].replace("%", "%%"))
    return parser


def make_parser(command: str, kind: type, known: Iterable[Option], with_help: object) -> argparse.ArgumentParser:
    """Returns the parser of a command, by default without help texts. What is not given is no attribute of its result.

    The options of a command that has many are listed in groups.
    """
    known = tuple(known)
    positional = "".join(f" {one.name}" for one in known if one.shown.is_positional)
    parser = Parser(
        f"rejeu {command}",
        f"rejeu {command}{positional} [options]",
        description=filled(inspect.cleandoc(kind.__doc__ or "")) if with_help else None,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        argument_default=argparse.SUPPRESS,
        allow_abbrev=False,
        exit_on_error=False,
    )
    docs = field_docs(kind) if with_help else {}
    lists: dict[Topic, Any] = dict.fromkeys(Topic, parser)
    if len(known) > MOST_IN_ONE_LIST:
        lists |= {one: parser.add_argument_group(one) for one in Topic if one is not Topic.FIRST}
    for one in known:
        text = docs.get(one.field, one.shown.help).replace("%", "%%")
        if one.kind is bool:
            lists[one.group].add_argument(
                one.name, dest=one.field, action="store_true", default=argparse.SUPPRESS, help=text
            )
            continue
        if isinstance(one.default, str | int | float | Path):
            text += f" (default: {one.default:g})" if isinstance(one.default, float) else f" (default: {one.default})"
        settings: dict[str, Any] = {
            "metavar": one.shown.metavar.removesuffix(" ..."),
            "help": text,
            "type": reader(one),
        }
        if one.takes_many:
            settings["nargs"] = "+" if one.is_required or not one.shown.is_positional else "*"
        elif one.shown.is_positional and not one.is_required:
            settings |= {"nargs": "?", "default": None}
        if one.shown.is_positional:
            parser.add_argument(one.field, **settings)
        else:
            many = {dict: "extend", tuple: "extend" if one.takes_many else "append"}
            lists[one.group].add_argument(one.name, dest=one.field, action=many.get(one.kind, "store"), **settings)
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


def problem(error: argparse.ArgumentError, command: str, words: Sequence[str]) -> str:
    """Returns the line about what ``argparse`` found wrong."""
    text, name = error.message, error.argument_name
    if name is None:
        missing = text.partition(": ")[2].replace(", ", " and ")
        return f"rejeu {command} needs {missing}; rejeu {command} --help shows what it takes"
    if text.startswith("ignored explicit argument"):
        return f"{name} takes no value, got {text.partition(' argument ')[2]}; leave it out or write {name} alone"
    if not text.startswith("expected"):
        return text
    place = next((i for i, word in enumerate(words) if normalized(word) == name), len(words))
    following = next(iter(words[place + 1 :]), "--")
    if following.startswith("--"):
        return f"{name} needs a value"
    return DASHED.format(name=name, text=following)


def reader(option: Option) -> Callable[[str], Any]:
    """Returns the function that reads a word of an option; what it raises becomes the message as it is."""

    def convert(text: str) -> Any:
        try:
            return read(option, text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return convert


def read(option: Option, text: str) -> Any:
    """Returns the value of a word.

    Raises:
        ValueError: if it is of the wrong type or out of range.
    """
    if get_origin(option.kind) is Literal and text not in get_args(option.kind):
        raise ValueError(f"{option.name} {text!r} must be one of {', '.join(get_args(option.kind))}")
    if option.item not in (int, float):
        if text.startswith("-"):
            raise ValueError(DASHED.format(name=option.name, text=text))
        return Path(text) if option.item is Path else text
    what = "whole number" if option.item is int else "number"
    try:
        value = int(text) if text.lstrip("+-").isdecimal() else float(text)
    except ValueError:
        raise ValueError(f"{option.name} {text!r} must be a {what}") from None
    if option.item is float:
        names = {"ge": "least", "gt": "above", "le": "most"}
        limits = {names[key]: limit for key, limit in option.limits.items() if limit < MOST}
        return number(option.name, float(value), **limits)
    if value != value // 1:
        raise ValueError(f"{option.name} {text} must be a whole number")
    return whole(option.name, int(value), int(option.limits.get("ge", 0)), int(option.limits.get("le", 2**63 - 1)))


def collected(option: Option, typed: Any) -> Any:
    """Returns the value of an option that was given: of one that may be repeated, that of all its words."""
    return assigned(typed, option.name) if option.kind is dict else tuple(typed) if option.kind is tuple else typed


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
