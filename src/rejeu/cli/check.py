"""``rejeu check``: what is wrong with an environment, before anything is trained on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from rejeu.cli.environment import EnvironmentOptions, named

if TYPE_CHECKING:
    import gymnasium as gym


@dataclass(frozen=True)
class Check(EnvironmentOptions):
    """Plays an environment for a few seconds and prints what is wrong with it; exit status 1 after errors.

    An environment of your own: rejeu check my_env.py, or my_package.my_module:MyEnv-v0, where the module registers it.
    """

    env: Annotated[Positional[str], arg(metavar="ENV")]
    """Id of an environment, such as parking-v0; or my_env:MyEnv-v0 or my_env.py, which is imported."""
    all: Annotated[bool, FlagCreatePairsOff] = False
    """Of an installed package's environment, show the warnings too, which only its authors can act on."""


def run(arguments: Check) -> int:
    """Prints the findings, errors first, and returns the exit status: 1 if there are errors, else 0."""
    from contextlib import closing

    from rejeu.envs.checker import findings

    with closing(named(arguments.env, arguments).make()) as env:
        found = sorted(findings(env))
        package = None if arguments.all else installed_package(env)
    n_notes = 0
    if package is not None:
        n_notes = len(found)
        found = [finding for finding in found if finding.level == "error"]
        n_notes -= len(found)
    for finding in found:
        print(f"{finding.level}: {finding.text}")
    n_errors = sum(finding.level == "error" for finding in found)
    print(f"{arguments.env}: {counted(n_errors, 'error')}, {counted(len(found) - n_errors, 'warning')}", flush=True)
    if n_notes:
        print(
            f"{counted(n_notes, 'warning')} on what only the authors of {package} can change; --all shows it",
            flush=True,
        )
    return int(n_errors > 0)


def installed_package(env: gym.Env) -> str | None:
    """Returns the package that an environment's class is of, if it was installed rather than written here."""
    import inspect
    import sysconfig
    from pathlib import Path

    kind = type(env.unwrapped)
    folders = {Path(sysconfig.get_path(name)).resolve() for name in ("purelib", "platlib")}
    package = kind.__module__.partition(".")[0]
    try:
        file = Path(inspect.getfile(kind)).resolve()
    except (TypeError, OSError):  # a class without a file, such as one typed into the interpreter
        return None
    return package if package == "rejeu" or any(file.is_relative_to(folder) for folder in folders) else None


def counted(n: int, what: str) -> str:
    """Returns a number of things in words.

    >>> counted(0, "error"), counted(1, "error"), counted(2, "error")
    ('no errors', '1 error', '2 errors')
    """
    return f"{n or 'no'} {what}{'' if n == 1 else 's'}"
