"""``rejeu check``: finds what is wrong with an environment before training."""

from __future__ import annotations

import inspect
import sysconfig
from contextlib import closing
from pathlib import Path

import gymnasium as gym

from rejeu.cli import environment, jsonout
from rejeu.cli.commands import Check
from rejeu.envs.checker import findings


def run(arguments: Check) -> int:
    """Prints the findings, errors first, and returns the exit status: 1 if there are errors, else 0."""
    with (
        jsonout.messages(arguments.json) as output,
        closing(environment.from_arguments(arguments.env, arguments).make()) as env,
    ):
        found = sorted(findings(env))
        package = None if arguments.all else installed_package(env)
    n_notes = 0
    if package is not None:
        n_notes = len(found)
        found = [finding for finding in found if finding.level == "error"]
        n_notes -= len(found)
    n_errors = sum(finding.level == "error" for finding in found)
    if arguments.json:
        counts = {"errors": n_errors, "warnings": len(found) - n_errors, "hidden_warnings": n_notes}
        found_as_dicts = [finding._asdict() for finding in found]
        jsonout.emit({"env_id": arguments.env, **counts, "findings": found_as_dicts}, output)
        return int(n_errors > 0)
    for finding in found:
        print(f"{finding.level}: {finding.text}")
    print(f"{arguments.env}: {counted(n_errors, 'error')}, {counted(len(found) - n_errors, 'warning')}", flush=True)
    if n_notes:
        print(
            f"{counted(n_notes, 'warning')} on what only the authors of {package} can change; --all shows it",
            flush=True,
        )
    return int(n_errors > 0)


def installed_package(env: gym.Env) -> str | None:
    """Returns the installed package that defines an environment's class, or None for the user's own code."""
    kind = type(env.unwrapped)
    folders = {Path(sysconfig.get_path(name)).resolve() for name in ("purelib", "platlib")}
    package = kind.__module__.partition(".")[0]
    try:
        file = Path(inspect.getfile(kind)).resolve()
    except (TypeError, OSError):  # a class without a file, such as one of a notebook
        return None
    return package if package == "rejeu" or any(file.is_relative_to(folder) for folder in folders) else None


def counted(n: int, what: str) -> str:
    """Returns a number with its noun.

    >>> counted(0, "error"), counted(1, "error"), counted(2, "error")
    ('no errors', '1 error', '2 errors')
    """
    return f"{n or 'no'} {what}{'' if n == 1 else 's'}"
