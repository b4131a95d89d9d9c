"""``rejeu report``: a page about one or several runs, as a file or followed live."""

from __future__ import annotations

import webbrowser
from contextlib import closing
from pathlib import Path

from rejeu.agents import load
from rejeu.cli.commands import Report
from rejeu.cli.environment import environment_of
from rejeu.interrupt import leaving
from rejeu.io import atomic
from rejeu.reporting.report import write_report
from rejeu.reporting.report.live import make_server
from rejeu.runs.folder import RunFolder, find_model
from rejeu.validation import whole

SUFFIXES = (".html", ".htm")


def run_report(arguments: Report) -> tuple[int, None]:
    """Writes the page, or serves it until Ctrl-C.

    Raises:
        ValueError: for ``--out`` or ``--replay`` with ``--live``, or for a file that is no page.
    """
    if arguments.live:
        if arguments.out is not None:
            raise ValueError("--live serves the page and writes no file; leave out --out, or --live")
        if arguments.replay is not None:
            raise ValueError("--replay plays the trained agent; leave out --replay, or --live")
        follow(arguments)
        return 0, None
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
    assert arguments.replay is not None
    folder = RunFolder(path)
    model = find_model(path, "best")
    agent = load(model)
    rows = ["seed,return,length,success"]
    with closing(environment_of(model, arguments).make()) as env:
        for seed in range(whole("--replay", arguments.replay, least=1)):
            played = agent.evaluate(1, env=env, seed=seed)
            rows.append(f"{seed},{played.mean_return},{played.mean_length:.0f},{played.success_rate}")
    with atomic.replacing(folder.replays) as file:
        file.write(("\n".join(rows) + "\n").encode())


def follow(arguments: Report) -> None:
    """Serves the page until Ctrl-C or SIGTERM ends the process."""
    server, address = make_server(arguments.runs)
    print(f"{address} (Ctrl-C ends it)", flush=True)
    if arguments.open:
        webbrowser.open(address)
    with server, leaving("the page is no longer served"):
        server.serve_forever()
