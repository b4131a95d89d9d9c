"""``rejeu studio``: runs to start, watch, play against and compare in the web browser."""

from __future__ import annotations

import webbrowser

from rejeu.core.errors import MissingExtra
from rejeu.lab.cli.commands import Studio


def run_studio(arguments: Studio) -> tuple[int, None]:
    """Serves the studio until Ctrl-C.

    Raises:
        MissingExtra: if NiceGUI is not installed.
        NotADirectoryError: if the folder is something else.
        OSError: if no port is free.
    """
    if arguments.folder.exists() and not arguments.folder.is_dir():
        raise NotADirectoryError(f"{arguments.folder} is no folder; expected one of runs, such as runs")
    try:
        import nicegui  # noqa: F401 - a missing one is named in one line
    except ImportError:
        raise MissingExtra("the studio", "nicegui", "studio") from None
    from rejeu.lab.studio import server, state

    def ready(address: str) -> None:
        print(f"{address} (Ctrl-C ends it; runs go on)", flush=True)
        if not arguments.no_browser:
            webbrowser.open(address)

    server.serve(state.Studio(arguments.folder), arguments.port, ready)
    return 0, None
