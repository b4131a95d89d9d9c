"""``rejeu studio``: runs to start, watch, play against and compare in the web browser."""

from __future__ import annotations

import webbrowser
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path

from rejeu.core import devices
from rejeu.core.errors import requires
from rejeu.lab.cli.commands import PORT, Studio
from rejeu.lab.cli.environment import Environment
from rejeu.lab.runs.config import EnvironmentOptions, RunConfig


def run_studio(arguments: Studio) -> tuple[int, None]:
    """Serves the studio until Ctrl-C.

    Raises:
        NotADirectoryError: if the folder is something else.
    """
    if arguments.folder.exists() and not arguments.folder.is_dir():
        raise NotADirectoryError(f"{arguments.folder} is no folder; expected one of runs, such as runs")
    given = {one.name: getattr(arguments, one.name) for one in fields(EnvironmentOptions)}
    typed = None if arguments.env is None else RunConfig(env=arguments.env, **given)
    open_studio(arguments.folder, arguments.port, not arguments.no_browser, typed=typed)
    return 0, None


def open_studio(
    folder: Path,
    port: int = PORT,
    has_browser: bool = True,
    guests: Mapping[str, tuple[Path, Environment]] | None = None,
    page: tuple[str, Sequence[tuple[str, str]]] = ("/", ()),
    typed: RunConfig | None = None,
) -> None:
    """Serves the studio until Ctrl-C.

    Args:
        folder: of the runs.
        port: the port, or the first free one after it; 0 for any.
        has_browser: whether the page is opened in the web browser.
        guests: models that may be elsewhere, with their environments, by their names.
        page: that is opened, and its query.
        typed: the environment that the command line names, and which runs may therefore import.

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
            webbrowser.open(address)

    studio = state.Studio(folder, guests)
    if typed is not None:
        studio.trust(typed)
    server.serve(studio, port, ready, page)
