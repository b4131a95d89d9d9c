"""The server of the studio: its pages, on a port of this computer."""

from __future__ import annotations

import secrets
import socket
import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import NamedTuple
from urllib.parse import urlencode

import uvicorn
from fastapi import FastAPI, Request, Response
from fastapi.responses import FileResponse
from nicegui import app, ui

from rejeu.lab.studio import classroom, compare, figures, new, play, run, runs
from rejeu.lab.studio.guard import HOST, Guard
from rejeu.lab.studio.layout import frame
from rejeu.lab.studio.saving import add_downloads
from rejeu.lab.studio.state import Studio

PORTS = 100
"""How many ports are tried."""
RECONNECT = 60.0
"""Seconds that a page has to connect again with what was typed into it; a computer that trains may be slow to answer."""

PICTURES = {"video.mp4": "video/mp4", "curve.png": "image/png"}


class Page(NamedTuple):
    """A page of the studio."""

    path: str
    title: str
    build: Callable[[Studio, Request], None]
    """Makes its elements, below the header. Query parameters are untrusted."""
    is_listed: bool = True
    """Whether the navigation leads to it."""


PAGES = (
    Page("/", "Runs", runs.build),
    Page("/new", "New run", new.build),
    Page("/play", "Play", play.build),
    Page("/compare", "Compare", compare.build),
    Page("/class", "Class", classroom.build),
    Page("/run", "Run", run.build, is_listed=False),
)


def serve(
    studio: Studio,
    port: int,
    ready: Callable[[str], None],
    page: tuple[str, Sequence[tuple[str, str]]] = ("/", ()),
    hosts: Sequence[str] = (),
) -> None:
    """Serves the studio until Ctrl-C; ``ready`` is called with the address.

    Args:
        studio: what is shown.
        port: the port, or the first free one after it; 0 for any.
        ready: called before the first request is answered.
        page: that the address leads to, and its query.
        hosts: further ``NAME:PORT`` under which it is asked, such as that of a tunnel.
    """
    with closing(bound(port)) as listening, studio:
        own_port = listening.getsockname()[1]
        token = secrets.token_urlsafe(24)
        server = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
        links = [(entry.path, entry.title) for entry in PAGES if entry.is_listed]
        figures.serve_scripts()
        add_files(studio)
        add_downloads(studio)
        for entry in PAGES:
            add(entry, studio, links)
        ui.run_with(server, title="rejeu studio", dark=None, show_welcome_message=False, reconnect_timeout=RECONNECT)
        guard = Guard(server, token, own_port, hosts)
        config = uvicorn.Config(guard, log_level="warning", ws_max_size=2**24, lifespan="on")
        path, query = page
        ready(f"http://{HOST}:{own_port}{path}?{urlencode([*query, ('token', token)])}")
        uvicorn.Server(config).run(sockets=[listening])


def add(page: Page, studio: Studio, links: list[tuple[str, str]]) -> None:
    """Adds a page to NiceGUI's application."""

    def show(request: Request) -> None:
        with frame(request, page.title, page.path, links):
            page.build(studio, request)

    ui.page(page.path, title=f"{page.title} · rejeu studio")(show)


def add_files(studio: Studio) -> None:
    """Serves the pictures of runs, and nothing else of their folders."""

    def show(name: str, run: str) -> Response:
        path = studio.file(run, name) if name in PICTURES else None
        return Response(status_code=404) if path is None else FileResponse(path, media_type=PICTURES[name])

    app.get("/file/{name}")(show)


def bound(port: int) -> socket.socket:
    """Returns a socket that listens on a port of this computer, or to the first free one after it.

    Raises:
        OSError: if none of them is free.
    """
    for number in range(port, min(port + PORTS, 65536)):
        listener = socket.socket()
        if sys.platform != "win32":  # connections of a studio that has just ended do not hold the port
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((HOST, number))
            listener.listen()
            return listener
        except OSError:
            listener.close()
    raise OSError(f"no port from {port} on is free on {HOST}; give another with --port, or 0 for any")
