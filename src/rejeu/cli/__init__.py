"""The command ``rejeu``: one file a command.

What a command needs is imported when it runs, so that asking for help is quick.
"""

from __future__ import annotations

import os
import re
import signal
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import tyro

from rejeu import interrupt
from rejeu.cli import arguments, check, evaluate, list as listing, play, record, resume, train, watch

COMMANDS: dict[str, tuple[type, Callable[[Any], int]]] = {
    "train": (train.Train, train.run),
    "resume": (resume.Resume, resume.run),
    "evaluate": (evaluate.Evaluate, evaluate.run),
    "record": (record.Record, record.run),
    "play": (play.Play, play.run),
    "watch": (watch.Watch, watch.run),
    "check": (check.Check, check.run),
    "list": (listing.List, listing.run),
}
"""Each command's arguments, and the function that takes them and returns the exit status."""

DESCRIPTION = """Trains agents on Gymnasium environments.

The shortest use: rejeu train parking-v0. Version: rejeu --version."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns the exit status: 0, 2 after an error, 130 after Ctrl-C, 143 after SIGTERM.

    Args:
        argv: without the program's name; None takes the process's own.

    Raises:
        SystemExit: after ``--help``, or if the arguments cannot be read.
    """
    argv = sys.argv[1:] if argv is None else argv
    if [*argv] == ["--version"]:
        from rejeu import __version__

        print(f"rejeu {__version__}")
        return 0
    if sys.platform.startswith("linux"):  # without it, SDL complains on every screen
        os.environ.setdefault("XDG_RUNTIME_DIR", tempfile.gettempdir())
    with interrupt.leaving(), warnings.catch_warnings():
        warnings.showwarning = show_warning
        return carry_out(argv)


def carry_out(argv: Sequence[str]) -> int:
    """Reads a command line, runs what it says and returns the exit status."""
    kinds: dict[str, Any] = {name: kind for name, (kind, _) in COMMANDS.items()}
    try:
        argv = arguments.checked(argv, kinds)
        given = tyro.extras.subcommand_cli_from_dict(kinds, prog="rejeu", description=DESCRIPTION, args=argv)
        run = next(function for kind, function in COMMANDS.values() if isinstance(given, kind))
        return run(given)
    except KeyboardInterrupt as error:
        print("rejeu: interrupted", file=sys.stderr)
        return 128 + (error.signal if isinstance(error, interrupt.Stopped) else signal.SIGINT)
    except expected_errors() as error:
        print(f"rejeu: error: {one_line(error)}", file=sys.stderr)
        return 2


def show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    """Prints a warning on one line, without the place in the code, which is no help on a command line."""
    print(f"warning: {one_line(message).removeprefix('WARN: ')}", file=sys.stderr, flush=True)


def expected_errors() -> tuple[type[Exception], ...]:
    """Returns the errors whose message is meant for the user; the others are defects and keep their traceback."""
    import gymnasium

    from rejeu import errors

    own: tuple[type[Exception], ...] = (errors.BadEnvironmentError, errors.NonFiniteError)
    own += (errors.RunInUseError, errors.WorkerError, gymnasium.error.Error)
    return ValueError, TypeError, ImportError, OSError, MemoryError, *own


def one_line(error: Exception | Warning | str) -> str:
    r"""Returns an error's or a warning's message on one line and without colors, or its kind if it has none.

    >>> one_line(ValueError("two\n  lines")), one_line(MemoryError())
    ('two lines', 'MemoryError')
    """
    return " ".join(re.sub(r"\x1b\[[\d;]*m", "", str(error)).split()) or type(error).__name__
