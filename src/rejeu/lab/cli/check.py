"""``rejeu check``: finds what is wrong with an environment before training."""

from __future__ import annotations

from contextlib import closing

from rejeu.core.types import JsonObject
from rejeu.lab.cli.commands import Check
from rejeu.lab.runs import environment
from rejeu.lab.runs.begin import is_installed
from rejeu.logs.formatting import counted


def run_check(arguments: Check) -> tuple[int, JsonObject]:
    """Prints the findings, errors first; the exit status is 1 if there are errors."""
    from rejeu.envs import checker  # Gymnasium's checker, which it imports, is for environments of one's own only

    with closing(environment.from_arguments(arguments.env, arguments).make()) as env:
        findings = sorted(checker.findings(env))
        module = type(env.unwrapped).__module__
    package = module.partition(".")[0] if is_installed(module) and not arguments.all else None
    shown = findings if package is None else [finding for finding in findings if finding.level == "error"]
    n_errors, n_hidden = sum(finding.level == "error" for finding in findings), len(findings) - len(shown)
    n_warnings = len(shown) - n_errors
    if not arguments.json:
        for finding in shown:
            print(f"{finding.level}: {finding.text}")
        print(f"{arguments.env}: {counted(n_errors, 'error')}, {counted(n_warnings, 'warning')}", flush=True)
        if n_hidden:
            text = f"{counted(n_hidden, 'warning')} on what only the authors of {package} can change; --all shows it"
            print(text, flush=True)
    counts = {"errors": n_errors, "warnings": n_warnings, "hidden_warnings": n_hidden}
    listed = [finding._asdict() for finding in shown]
    return int(n_errors > 0), {"env_id": arguments.env, **counts, "findings": listed}
