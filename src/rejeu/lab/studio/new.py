"""The page on which a run is started: a form made from the options of ``rejeu train``."""

from __future__ import annotations

import asyncio
import json
import os
import re
import shlex
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from fastapi import Request
from nicegui import ui

from rejeu.agents import AGENTS, presets
from rejeu.checkpoints.run_folder import dated
from rejeu.core.interrupt import program
from rejeu.core.records import shown
from rejeu.core.validation import field_docs
from rejeu.envs.registry import in_envpool, is_plain_id, register, unknown_environment
from rejeu.lab.reporting.run_list import MAX_DEPTH, SKIPPED, find, is_run
from rejeu.lab.runs import parsing
from rejeu.lab.runs.arguments import Train, check_options
from rejeu.lab.runs.config import Option, Topic, options
from rejeu.lab.runs.read import MAX_NAME
from rejeu.lab.studio import processes
from rejeu.lab.studio.layout import action, address, env_select
from rejeu.lab.studio.speech import say
from rejeu.lab.studio.state import Studio
from rejeu.logs.formatting import quoted

LEFT_OUT = {"assist", "json", "fps"}
"""Options that need a window, or are for programs."""
LABELS = {"hyperparameters": "hyperparameters", "n_envs": "environments at once", "out": "folder"}
"""Of fields, where the option is called otherwise."""
PRESET = {
    "algorithm": "algorithm", "total_steps": "steps", "n_envs": "n_envs", "evaluate_every": "evaluate_every",
    "evaluate_episodes": "evaluate_episodes", "success_threshold": "success_threshold", "hyperparameters": "hyperparameters",
}  # fmt: skip
"""Fields of the form by those of a preset."""
LOOK = 0.5
"""Seconds between two looks whether the run has begun."""
NAME = re.compile(r"(?!(con|prn|aux|nul|com\d|lpt\d)(\.|$))[\w(][\w .,()+=@-]*(?<![ .])", re.IGNORECASE)
"""Names of folders that every system takes."""
Texts = Mapping[str, Any]
"""Content of the form: texts, and of flags whether they are set, by field."""


def build(studio: Studio, request: Request) -> None:
    """Makes the form."""
    docs, lists = field_docs(Train), {topic: [] for topic in Topic}  # type: dict[str, str], dict[Topic, list[Option]]
    for option in options(Train):
        if option.field not in LEFT_OUT:
            lists[option.group].append(option)
    fields: dict[str, Any] = {}
    for topic, listed in lists.items():
        container = (
            ui.element("div") if topic is Topic.FIRST else ui.expansion(say(topic.capitalize())).classes("w-full")
        )
        with container.classes("w-full"), ui.element("div").classes("charts w-full"):
            fields |= {option.field: make_field(option, docs.get(option.field, option.shown.help)) for option in listed}
    fields["env"].value = prefilled(request)
    with ui.row().classes("items-center"):
        button = ui.button(say("Start"), icon="play_arrow").props("no-caps")
        spinner = ui.spinner()
        spinner.set_visibility(False)
    message = ui.label().classes("text mono")
    ui.label(say("The same on the command line:")).classes("quiet")
    equivalent = ui.label().classes("text mono")

    def show() -> None:
        texts = {name: field.value for name, field in fields.items()}
        for name, text in preset_texts(texts).items():
            fields[name].props["placeholder"] = text
        equivalent.text = command_text(texts, studio)

    for field in fields.values():
        field.on_value_change(show)
    show()

    async def begin() -> None:
        button.disable()
        spinner.set_visibility(True)
        message.text, button.text = "", say("Starting ...")
        try:
            message.text = await start(studio, {name: field.value for name, field in fields.items()}, message.set_text)
        except (ValueError, OSError) as error:
            message.text = str(error)
        button.text = say("Start")
        button.enable()
        spinner.set_visibility(False)

    button.on_click(begin)


def prefilled(request: Request) -> str | None:
    """Returns the environment that an address names, which may not be one that is imported."""
    env_id = request.query_params.get("env")
    return env_id if is_plain_id(env_id) else None


def preset_texts(texts: Texts) -> dict[str, str]:
    """Returns the values that a run has where nothing is entered, by field: those of the preset, if there is one."""
    preset = presets.find(texts.get("env") or "", texts.get("algorithm") or None)
    if preset is None:
        return dict.fromkeys(PRESET.values(), "")
    values = {field: getattr(preset, name) for name, field in PRESET.items()}
    settings = preset.hyperparameters.items()
    hyperparameters = " ".join(quoted(f"{name}={json.dumps(value)}") for name, value in settings)
    texts = {field: "" if value is None else str(value) for field, value in values.items()}
    return {**texts, "hyperparameters": hyperparameters}


def command_text(texts: Texts, studio: Studio) -> str:
    """Returns the command that starts the run of a form, as it is typed; a mistake in the form is said instead."""
    try:
        return " ".join(map(quoted, ["rejeu", *command(texts, studio)[0]]))
    except ValueError as error:
        return in_form(str(error))


def make_field(option: Option, doc: str) -> Any:
    """Returns the element in which an option is entered."""
    label = say(LABELS.get(option.field, option.name.removeprefix("--").replace("-", " ").lower()))
    if option.type is bool:
        element: Any = ui.switch(label)
    elif option.field == "env":
        element = env_select(sorted({preset.env_id for preset in presets.every()}))
    elif option.field == "algorithm":
        element = ui.select(sorted(AGENTS), label=say("algorithm"), with_input=True, clearable=True)
    elif get_origin(option.type) is Literal:
        element = ui.select([*get_args(option.type)], label=label, clearable=True)
    else:
        element = ui.input(label, validation=lambda text: problem_of(option, text))
    if option.type is not bool:
        element.props("dense outlined stack-label bottom-slots hide-bottom-space").props.update(hint=say(in_form(doc)))
    return element


def in_form(doc: str) -> str:
    """Returns the help of an option in the words of the form.

    >>> in_form("With --backend ray: one module; repeat for several.")
    'With backend ray: one module; several with spaces between them.'
    """
    words = re.sub(r"--(?=\w)|rejeu (?=resume|branch|tune)", "", doc)
    return words.replace("repeat for several", "several with spaces between them")


def problem_of(option: Option, text: str | None) -> str | None:
    """Returns the mistake in a text, None if there is none."""
    try:
        words_of(option, text)
    except ValueError as error:
        return in_form(str(error))
    return None


def words_of(option: Option, value: object) -> list[str]:
    """Returns an option as words of a command line, none if nothing was entered.

    Raises:
        ValueError: if it is not what the option takes.
    """
    if value in (None, "", False):
        return []
    name = [] if option.shown.is_positional else [option.name]
    if option.type is bool:
        return name
    words = shlex.split(str(value)) if option.type in (dict, tuple) else [str(value).strip()]
    if option.type not in (dict, tuple):
        parsing.read(option, words[0])
    if option.takes_many or option.type is dict:
        return [*name, *words]
    return [text for word in words for text in (*name, word)]


def command(texts: Texts, studio: Studio) -> tuple[list[str], Train]:
    """Returns the words of the command that starts a run in the folder of a studio, and its arguments.

    Raises:
        ValueError: for a mistake, as the command line says it, or a folder elsewhere.
    """
    if not texts.get("env"):
        raise ValueError(say("choose an environment"))
    folder = str(texts.get("out") or dated(texts["env"], texts.get("algorithm")).name[-150:].lstrip("-. "))
    values = {**texts, "out": str(new_folder(studio, folder))}
    words = [word for option in options(Train) for word in words_of(option, values.get(option.field))]
    words += [word for name in studio.imports for word in ("--import", name)]
    _, arguments = parsing.parse(["train", *words], {"train": Train}, {}, "")
    check_options(arguments)
    return ["train", *words], arguments


def new_folder(studio: Studio, name: str) -> Path:
    """Returns the path of a folder for a new run, which is then found below the folder of the studio, on every system.

    Raises:
        ValueError: if it exists, or no run can be there.
    """
    path = studio.below(name)
    folders = path.relative_to(studio.folder).parts
    is_valid = folders and all(NAME.fullmatch(folder) and len(os.fsencode(folder)) <= MAX_NAME for folder in folders)
    if not is_valid or len(folders) >= MAX_DEPTH or SKIPPED & {*folders}:
        raise ValueError(
            f"folder {shown(name)!r} must be a name such as sac-1 or group/sac-1: letters, digits, spaces and ._-()+=@, the "
            f"first one a letter or a digit, the last one no dot or space, {MAX_NAME} bytes at most, and none that Windows "
            "or runs reserve, such as con and videos"
        )
    for parent in path.parents[: len(folders)]:
        if is_run(parent) or (parent.exists() and not parent.is_dir()):
            raise ValueError(f"folder {name!r} would be in {parent}, which is a run or a file; name another")
    check_new(path)
    return path


def check_new(path: Path) -> None:
    """Raises ``ValueError`` if there is a file or a folder."""
    if os.path.lexists(path):
        raise ValueError(f"folder {path} exists; name another, or remove it first")


async def start(studio: Studio, texts: Texts, show: Callable[[str], object]) -> str:
    """Checks the environment and starts the run, and leads to its page; returns what went wrong, if anything did.

    An environment with a preset is not checked: the tests of rejeu do that.
    """
    words, arguments = command(texts, studio)
    if presets.find(arguments.env, None) is None:
        await asyncio.to_thread(require_known, arguments)
        show(say("The environment is tried for a few seconds ..."))
        status, printed = await check(arguments)
        if status:
            return printed
        show(printed)
    studio.trust(arguments)
    return await lead_to(studio, words, Path(arguments.out or ""), show)


def require_known(arguments: Train) -> None:
    """Raises an error for an id that no package registers; a process of ``rejeu check`` would take seconds for that.

    Raises:
        ValueError: with similar ids.
    """
    env_id = arguments.env
    if not (not is_plain_id(env_id) or arguments.imports or register(env_id) or in_envpool(env_id)):
        raise ValueError(unknown_environment(env_id))


async def lead_to(studio: Studio, words: Sequence[str], path: Path, show: Callable[[str], object]) -> str:
    """Starts a run by a command, and leads to its page once it has begun; returns what went wrong, if anything did.

    Until then ``show`` gets what the command has printed last.
    """
    check_new(path)  # also a while after the form was read
    process = processes.start(words, path)
    name = path.relative_to(studio.folder).as_posix()
    with stoppable(process):
        while not studio.holds(name):
            if process.poll() is not None and not (path.is_dir() and find(path)):
                return processes.read_log(path) or f"rejeu {words[0]} ended with exit status {process.returncode}"
            show(processes.last_line(path) or say("JAX is loaded, and environments are made ..."))
            await asyncio.sleep(LOOK)
    ui.navigate.to(address("/run", run=name))
    return ""


@contextmanager
def stoppable(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """Context in which a button ends a process, of which nothing is written yet."""
    button = action(say("Stop"), "stop", process.terminate)
    try:
        yield
    finally:
        button.delete()


async def check(arguments: Train) -> tuple[int, str]:
    """Returns exit status and output of ``rejeu check`` for the environment of a run.

    A thread waits for it: a process of uvloop's own is a fork, against which JAX warns.
    """
    command = program("-m", "rejeu", "check", *arguments.environment_words())
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    with stoppable(process):
        printed, _ = await asyncio.to_thread(process.communicate)
    text = processes.plain(printed.decode("utf-8", "replace"))
    return process.returncode, text or f"rejeu check ended with exit status {process.returncode}"
