"""``rejeu studio``: runs to start, watch, play against and compare in the web browser."""

from __future__ import annotations

import html
import os
import tempfile
import webbrowser
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import fields
from pathlib import Path

from rejeu.core import devices, interrupt
from rejeu.core.errors import requires
from rejeu.lab.cli.commands import PORT, Studio
from rejeu.lab.runs.arguments import RunOptions
from rejeu.lab.runs.config import EnvironmentOptions, RunConfig
from rejeu.lab.runs.environment import Environment, from_arguments

NOTHING = RunOptions()


def run_studio(arguments: Studio) -> tuple[int, None]:
    """Serves the studio until Ctrl-C.

    Raises:
        NotADirectoryError: if the folder is something else.
    """
    if arguments.folder.exists() and not arguments.folder.is_dir():
        raise NotADirectoryError(f"{arguments.folder} is no folder; expected one of runs, such as runs")
    folder, port, has_browser = arguments.folder, arguments.port, not arguments.no_browser
    open_studio(folder, port, has_browser, options=arguments, hosts=arguments.allow_host)
    return 0, None


def open_studio(
    folder: Path,
    port: int = PORT,
    has_browser: bool = True,
    guests: Mapping[str, tuple[Path, Environment]] | None = None,
    page: tuple[str, Sequence[tuple[str, str]]] = ("/", ()),
    options: RunOptions = NOTHING,
    hosts: Sequence[str] = (),
) -> None:
    """Serves the studio until Ctrl-C.

    Args:
        folder: of the runs.
        port: the port, or the first free one after it; 0 for any.
        has_browser: whether the page is opened in the web browser.
        guests: models that may be elsewhere, with their environments, by their names.
        page: that is opened, and its query.
        options: the environment and the modules that the command line names, and which runs may therefore import.
        hosts: further ``NAME:PORT`` under which the studio is asked.

    Raises:
        MissingExtra: if NiceGUI is not installed.
        OSError: if no port is free.
    """
    with requires("the studio", "nicegui", "studio"):
        import nicegui  # noqa: F401 - a missing one is named in one line
    devices.start_with("--device", "cpu")  # the memory of a GPU is for what trains
    from rejeu.lab.studio import server, state

    def ready(address: str) -> None:
        print(f"{address} (Ctrl-C ends it; runs go on)", flush=True)
        if has_browser:
            webbrowser.open(pages.enter_context(redirection(address)))

    env_id = "" if options.env is None else from_arguments(options.env, options).env_id
    values = {field.name: getattr(options, field.name) for field in fields(EnvironmentOptions)}
    typed = RunConfig(env=env_id, env_argument=options.env or "", **values)
    with ExitStack() as pages:
        server.serve(state.Studio(folder, guests, typed), port, ready, page, hosts)


@contextmanager
def redirection(address: str) -> Iterator[str]:
    """Context with the address of a file that leads to another address, whose token is then on no command line.

    Only this user may read the file; every user of a computer may read command lines.
    """
    handle, name = tempfile.mkstemp(".html", "rejeu-studio-")
    path = Path(name)
    interrupt.unfinished.add(path)  # a signal removes it too
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(f'<!DOCTYPE html><meta http-equiv="refresh" content="0; url={html.escape(address)}">')
        yield path.as_uri()
    finally:
        path.unlink(missing_ok=True)
        interrupt.unfinished.discard(path)
