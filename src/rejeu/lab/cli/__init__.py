"""The command ``rejeu``: the arguments are in :mod:`rejeu.lab.cli.commands`, what each command does in a module of its name.

That module is imported when the command runs, so that help and errors in the arguments are quick. With ``--json`` a result is
one document on standard output, and nothing else is there.
"""

from __future__ import annotations

import importlib
import io
import os
import signal
import sys
import sysconfig
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path

import msgspec

import rejeu
from rejeu.core import errors, hardware, interrupt
from rejeu.core.records import utf8
from rejeu.core.types import JsonObject
from rejeu.lab.cli.commands import COMMANDS, MODULES, TASKS, TRAINING
from rejeu.lab.runs import parsing
from rejeu.lab.runs.arguments import check_options, of_task
from rejeu.lab.runs.config import read_task
from rejeu.logs.formatting import quoted

DESCRIPTION = """Trains agents on Gymnasium environments.

The shortest use: rejeu train parking-v0. Version: rejeu --version."""

CLOSED = 141
"""Exit status if the reader of the output has closed it, as after ``| head``; that of SIGPIPE in shells."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns the exit status: 0, 2 after an error, 130 after Ctrl-C, 143 after SIGTERM.

    Args:
        argv: without the program's name; None takes the process's own.

    Raises:
        SystemExit: after ``--help``, or if the arguments cannot be read.
    """
    argv = sys.argv[1:] if argv is None else argv
    if [*argv] == ["--version"]:
        print(f"rejeu {rejeu.__version__}")
        return 0
    for stream in (sys.stdout, sys.stderr):  # a pipe may have an encoding without ±
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    hardware.quiet_sdl()
    with interrupt.leaving(), warnings.catch_warnings():
        interrupt.by_parent()
        warnings.showwarning = show_warning
        status = run_command(argv)
    if status in (128 + number for number in interrupt.NAMES):
        interrupt.ignore()
    return status


def run_command(argv: Sequence[str]) -> int:
    """Parses a command line, runs the command and returns the exit status."""
    is_task = [*argv[:1]] == ["--task"] and len(argv) == 2
    try:
        command, arguments = (
            of_task(read_task(Path(argv[1]))) if is_task else parsing.parse(argv, COMMANDS, TASKS, DESCRIPTION)
        )
        check_options(arguments)
        for name in getattr(arguments, "imports", ()):
            importlib.import_module("rejeu.lab.runs.environment").import_source(name)
        with messages(getattr(arguments, "json", False)) as emit:
            if command in TRAINING:
                print(f"command       rejeu {' '.join(map(quoted, argv))}", flush=True)
            module = importlib.import_module(f"rejeu.lab.cli.{MODULES.get(command, command)}")
            status, result = getattr(module, f"run_{command}")(arguments)
            emit(result)
        return status
    except KeyboardInterrupt as error:
        print("rejeu: interrupted", file=sys.stderr)
        return 128 + (error.signal if isinstance(error, interrupt.Stopped) else signal.SIGINT)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else Python complains when it exits
        return CLOSED
    except Exception as error:
        if not isinstance(error, errors.expected_errors()):
            raise
        has_trace = isinstance(error, errors.WorkerError)  # of the environment's code
        print(f"rejeu: error: {error if has_trace else errors.one_line(error)}{place_of(error)}", file=sys.stderr)
        was_slower = is_task and isinstance(error, errors.RunInUseError | FileExistsError)
        return interrupt.TAKEN if was_slower else 2


def show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """Prints a warning on one line, without the line of code that it comes from."""
    print(f"warning: {errors.one_line(message).removeprefix('WARN: ')}", file=sys.stderr, flush=True)


def place_of(error: Exception) -> str:
    """Returns where the user's own code raised an error, such as an environment, or what it should do; else nothing."""
    not_own = Path(sysconfig.get_path("stdlib")).resolve(), Path(rejeu.__file__).resolve().parent
    cause = error.__cause__ or error
    for frame, line in reversed([*traceback.walk_tb(error.__traceback__), *traceback.walk_tb(cause.__traceback__)]):
        path = Path(frame.f_code.co_filename).resolve()
        is_installed = "site-packages" in path.parts or any(path.is_relative_to(folder) for folder in not_own)
        if path.is_file() and not is_installed:
            return f" ({path.name}, line {line}, in {frame.f_code.co_name})"
    if isinstance(error, ModuleNotFoundError) and errors.installed("jax") is None:
        return (
            "; rejeu is installed without its dependencies, which only rejeu.load_policy can do without: install them"
        )
    if "values to unpack (expected 5" in str(error):  # by a wrapper of Gymnasium
        return "; step must return observation, reward, terminated, truncated and info"
    return ""


@contextmanager
def messages(is_json: bool) -> Iterator[Callable[[JsonObject], None]]:
    """Context that yields a function to call with the result, which prints it with ``is_json`` and else does nothing.

    With ``is_json``, what is printed otherwise goes to standard error.
    """
    if not is_json:
        yield lambda result: None
        return
    output = sys.stdout
    with redirect_stdout(sys.stderr):
        yield lambda result: print(dumps(result), file=output, flush=True)


def dumps(value: object) -> str:
    """Returns a value as indented JSON text. NaN and infinities become null, since JSON has none.

    >>> import math, pathlib
    >>> import numpy as np
    >>> print(dumps({"steps": np.int64(3), "return": math.nan, "path": pathlib.PurePosixPath("runs/a")}))
    {
      "steps": 3,
      "return": null,
      "path": "runs/a"
    }
    """
    return msgspec.json.format(msgspec.json.encode(value, enc_hook=plain), indent=2).decode()


def plain(value: object) -> object:
    """Returns a NumPy array or number as Python's, a mapping as a dict, and anything else as text."""
    import numpy as np  # takes longer than all that --help needs

    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    return dict(value) if isinstance(value, Mapping) else utf8(value)
