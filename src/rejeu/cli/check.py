"""``rejeu check``: what is wrong with an environment, before anything is trained on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Positional, arg

from rejeu.cli.environment import EnvironmentOptions, named


@dataclass(frozen=True)
class Check(EnvironmentOptions):
    """Plays an environment for a few seconds and prints what is wrong with it; exit status 1 after errors.

    An environment of your own: rejeu check my_env.py, or my_package.my_module:MyEnv-v0, where the module registers it.
    """

    env: Annotated[Positional[str], arg(metavar="ENV")]
    """Id of an environment, such as parking-v0; or my_env:MyEnv-v0 or my_env.py, which is imported."""


def run(arguments: Check) -> int:
    """Prints the findings, errors first, and returns the exit status: 1 if there are errors, else 0."""
    from contextlib import closing

    from rejeu.envs.checker import findings

    with closing(named(arguments.env, arguments).make()) as env:
        found = sorted(findings(env))
    for finding in found:
        print(f"{finding.level}: {finding.text}")
    n_errors = sum(finding.level == "error" for finding in found)
    print(f"{arguments.env}: {counted(n_errors, 'error')}, {counted(len(found) - n_errors, 'warning')}", flush=True)
    return int(n_errors > 0)


def counted(n: int, what: str) -> str:
    """Returns a number of things in words.

    >>> counted(0, "error"), counted(1, "error"), counted(2, "error")
    ('no errors', '1 error', '2 errors')
    """
    return f"{n or 'no'} {what}{'' if n == 1 else 's'}"
