"""A report that is served to this computer only, and follows runs while they train."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock
from typing import Any
from urllib.parse import parse_qs, urlsplit

from rejeu.lab.reporting.report import page, sections
from rejeu.lab.reporting.runs import CONFIG, EPISODES, EVALUATIONS, METRICS, WARNINGS, read_run

HOST = "127.0.0.1"
FILES = (CONFIG, EPISODES, METRICS, EVALUATIONS, WARNINGS, "agent.safetensors")
PATIENCE = 10.0
"""Seconds after which runs are read again though no file has changed: a process may have ended."""


class LivePage:
    """The page and the data of runs that are followed. Thread-safe."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """Reads the runs.

        Raises:
            FileNotFoundError: if a folder does not exist, or holds nothing of a run.
        """
        self.paths = [*paths]
        self._lock = Lock()
        self._stamps: Any = None
        self._read_at = 0.0
        self._title = ""
        self._parts = sections.Parts([], {})
        self._version = ""
        self.refresh()

    def refresh(self) -> tuple[sections.Parts, str, str]:
        """Returns content, version and title, read again if a file has changed."""
        with self._lock:
            stamps = [stamp(path / name) for path in self.paths for name in FILES]
            if stamps != self._stamps or time.monotonic() - self._read_at > PATIENCE:
                runs = [read_run(path) for path in self.paths]
                self._parts, self._title = sections.build(runs, None), sections.title_of(runs)
                self._stamps, self._read_at = stamps, time.monotonic()
                content = json.dumps([self._parts.runs, self._parts.data], allow_nan=False, default=str)
                self._version = hashlib.blake2b(content.encode(), digest_size=12).hexdigest()
            return self._parts, self._version, self._title

    def page(self) -> bytes:
        """Returns the page."""
        parts, version, title = self.refresh()
        data = {**parts.data, "version": version}
        return page.render("report.html", data, live=True, title=title, runs=parts.runs).encode()

    def data(self, version: str) -> bytes | None:
        """Returns what has changed since a version as JSON, None if nothing has."""
        parts, now, _ = self.refresh()
        if version == now:
            return None
        names = ("headline", "evaluations")
        html = {f"{run['id']}-{name}": page.part(name, run) for run in parts.runs for name in names}
        return json.dumps({**parts.data, "version": now, "parts": html}, allow_nan=False).encode()


def stamp(path: Path) -> tuple[int, int] | None:
    """Returns time and size of a file, None if it does not exist."""
    try:
        status = path.lstat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size


def handler(live: LivePage, hosts: Callable[[], set[str]]) -> type[BaseHTTPRequestHandler]:
    """Returns a request handler that answers for the page and its data, and to no other host name."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            try:
                self._reply()
            except ConnectionError:  # the page was closed while it was sent
                self.close_connection = True
            except OSError as error:  # the run folder is gone
                self._answer(503, str(error).encode(), "text/plain; charset=utf-8")

        def _reply(self) -> None:
            address = urlsplit(self.path)
            if self.headers.get("Host") not in hosts():  # another site's name that leads here
                self._answer(403, b"unknown host", "text/plain")
            elif address.path == "/":
                self._answer(200, live.page(), "text/html; charset=utf-8")
            elif address.path == "/data.json":
                content = live.data(parse_qs(address.query).get("version", [""])[0])
                self._answer(204 if content is None else 200, content or b"", "application/json")
            else:
                self._answer(404, b"not found", "text/plain")

        def _answer(self, status: int, content: bytes, kind: str) -> None:
            self.send_response(status)
            headers = {"Content-Type": kind, "Content-Length": str(len(content)), "Cache-Control": "no-store"}
            headers |= {"X-Content-Type-Options": "nosniff", "X-Frame-Options": "DENY"}
            headers |= {"Cross-Origin-Resource-Policy": "same-origin"}
            for name, value in headers.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - the name in the base class
            """Prints nothing."""

    return Handler


def make_server(paths: Sequence[Path], port: int = 0) -> tuple[ThreadingHTTPServer, str]:
    """Returns a server for the report of some runs, bound to this computer, and its address.

    Args:
        paths: run folders.
        port: 0 for a free one.
    """
    names: set[str] = set()
    server = ThreadingHTTPServer((HOST, port), handler(LivePage(paths), lambda: names))
    server.daemon_threads = True
    names |= {f"{name}:{server.server_port}" for name in (HOST, "localhost")}
    return server, f"http://{HOST}:{server.server_port}/"
