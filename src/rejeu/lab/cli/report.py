"""``rejeu report``: a page about runs."""

from __future__ import annotations

import webbrowser
from contextlib import closing
from pathlib import Path
from typing import Any

from rejeu.checkpoints.run_folder import RunFolder, find_model
from rejeu.core import atomic
from rejeu.core.validation import whole
from rejeu.lab.cli.commands import Report
from rejeu.lab.reporting.report import write_report
from rejeu.logs.tables import written

SUFFIXES = (".html", ".htm")


def run_report(arguments: Report) -> tuple[int, None]:
    """Writes the page.

    Raises:
        ValueError: for a file that is no page.
    """
    if arguments.out is not None and arguments.out.suffix.lower() not in SUFFIXES:
        raise ValueError(f"--out {arguments.out} must end in {' or '.join(SUFFIXES)}")
    for path in arguments.runs if arguments.replay is not None else ():
        replay(path, arguments)
    path = write_report(arguments.runs, arguments.out)
    print(path, flush=True)
    if arguments.open:
        webbrowser.open(path.absolute().as_uri())
    return 0, None


def replay(path: Path, arguments: Report) -> None:
    """Lets the best model of a run play episodes from the seeds 0, 1, 2 ..., and writes them to its folder.

    Each is what ``rejeu watch`` and ``rejeu record`` show with ``--seed`` and ``--episodes 1``.

    Raises:
        FileNotFoundError: if the folder holds no model.
        ValueError: if the environment cannot be made.
    """
    from rejeu.agents import load  # JAX takes longer than all that rejeu status needs
    from rejeu.lab.runs.environment import environment_of

    assert arguments.replay is not None
    model = find_model(path)
    agent = load(model)
    rows: list[list[Any]] = []
    with closing(environment_of(model, arguments).make()) as env:
        for seed in range(whole("--replay", arguments.replay, least=1)):
            played = agent.evaluate(1, env=env, seed=seed)
            goals = played.goals[0] if len(played.goals) else ()
            rows.append([seed, played.mean_return, f"{played.mean_length:.0f}", played.success_rate, *goals])
    atomic.write(RunFolder(path).replays, written(["seed", "return", "length", "success"], rows))
