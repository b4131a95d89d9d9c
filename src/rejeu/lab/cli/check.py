"""``rejeu check``: finds what is wrong with an environment before training."""

from __future__ import annotations

import random
import sys
import warnings
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from rejeu.core.errors import BadEnvironmentError
from rejeu.lab.cli import environment
from rejeu.lab.cli.commands import Check
from rejeu.lab.cli.environment import Environment, module_of


def run_check(arguments: Check) -> tuple[int, dict[str, Any]]:
    """Prints the findings, errors first; the exit status is 1 if there are errors."""
    from rejeu.envs import checker  # Gymnasium's checker, which it imports, is for environments of one's own only

    with closing(environment.from_arguments(arguments.env, arguments).make()) as env:
        found = sorted(checker.findings(env))
        package = None if arguments.all else installed_package(env)
    shown = found if package is None else [finding for finding in found if finding.level == "error"]
    n_errors, n_hidden = sum(finding.level == "error" for finding in found), len(found) - len(shown)
    n_warnings = len(shown) - n_errors
    if not arguments.json:
        for finding in shown:
            print(f"{finding.level}: {finding.text}")
        print(f"{arguments.env}: {counted(n_errors, 'error')}, {counted(n_warnings, 'warning')}", flush=True)
        if n_hidden:
            text = f"{counted(n_hidden, 'warning')} on what only the authors of {package} can change; --all shows it"
            print(text, flush=True)
    counts = {"errors": n_errors, "warnings": n_warnings, "hidden_warnings": n_hidden}
    findings = [finding._asdict() for finding in shown]
    return int(n_errors > 0), {"env_id": arguments.env, **counts, "findings": findings}


def before_training(made: Environment, config: Any) -> None:
    """Prints the errors of an environment of one's own, and warns of episodes that never end; ``config`` is the algorithm's.

    A new environment takes some steps; random numbers of NumPy and Python are as before.

    Raises:
        BadEnvironmentError: if there are errors.
    """
    if not is_own(made):
        return
    from rejeu.envs import checker

    states = random.getstate(), np.random.get_state()  # noqa: NPY002 - of other code
    with closing(made.make()) as env:
        keeps_infos = getattr(getattr(config, "hindsight", None), "copy_info_dict", False)
        found = sorted(checker.quick_findings(env, keeps_infos))
    random.setstate(states[0])
    np.random.set_state(states[1])  # noqa: NPY002
    errors = [finding.text for finding in found if finding.level == "error"]
    for finding in found:
        if finding.level == "warning":
            warnings.warn(finding.text, UserWarning, stacklevel=2)
    for text in errors:
        print(f"error: {text}", file=sys.stderr)
    if errors:
        raise BadEnvironmentError(
            f"{made.run.env} has {counted(len(errors), 'error')}, so nothing is trained; rejeu check shows its warnings too"
        )


def is_own(made: Environment) -> bool:
    """Returns whether the code of an environment or of a wrapper is not that of an installed package."""
    spec = gym.registry.get(made.env_id)
    parts = [] if spec is None else [spec.entry_point, *(one.entry_point for one in spec.additional_wrappers)]
    modules = [module_of(one) for one in (*parts, *made.wrappers)]
    return any(module is not None and not is_installed(module) for module in modules)


def is_installed(module: str) -> bool:
    """Returns whether a module is part of an installed package, or not imported yet, which those of one's own are."""
    package = module.partition(".")[0]
    found = sys.modules.get(package)
    if found is None or package == "rejeu":
        return True
    places = [getattr(found, "__file__", None), *getattr(found, "__path__", ())]
    return any({"site-packages", "dist-packages"} & {*Path(place).resolve().parts} for place in places if place)


def installed_package(env: gym.Env) -> str | None:
    """Returns the installed package that defines an environment's class, or None for the user's own code."""
    module = type(env.unwrapped).__module__
    return module.partition(".")[0] if is_installed(module) else None


def counted(n: int, what: str) -> str:
    """Returns a number with its noun.

    >>> counted(0, "error"), counted(1, "error"), counted(2, "error")
    ('no errors', '1 error', '2 errors')
    """
    return f"{n or 'no'} {what}{'' if n == 1 else 's'}"
