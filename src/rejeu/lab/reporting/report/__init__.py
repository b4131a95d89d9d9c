"""Reports of runs: one HTML page that needs no network, with curves, tables, videos and the command that repeats the run.

Everything in a run folder is untrusted. Jinja2 escapes all text, JSON is escaped for scripts, and the page's
Content-Security-Policy allows its own scripts by a random nonce and nothing from elsewhere. A report that is served to this
computer only follows runs while they train.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Iterable, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock
from typing import Any
from urllib.parse import parse_qs, urlsplit

from rejeu.agents.agent import Agent
from rejeu.algorithms import config as configs
from rejeu.core import atomic
from rejeu.lab.reporting.report import page, sections
from rejeu.lab.reporting.runs import CONFIG, EPISODES, EVALUATIONS, METRICS, WARNINGS, RunSummary, read_run
from rejeu.logs.evaluation import Evaluation
from rejeu.logs.tables import Episodes, Table, evaluation_table

MAX_RUNS = 50
"""Most runs of a page."""


def write_report(
    runs: str | Path | Agent | Sequence[str | Path],
    out: str | Path | None = None,
    evaluations: Iterable[tuple[int, Evaluation]] = (),
) -> Path:
    """Writes the report of one or several runs as one HTML page, and returns its path.

    Args:
        runs: run folders, or an agent, whose training so far is shown.
        out: file to write; None for ``report.html`` in the folder of a single run, or in the current folder.
        evaluations: of an agent: ``(step, Evaluation)`` pairs, such as ``Evaluate.results``.

    Raises:
        FileNotFoundError: if a folder does not exist, or holds nothing of a run.
        MissingExtra: if plotly or jinja2 is not installed.
        ValueError: for no run, or more than ``MAX_RUNS``.
    """
    if isinstance(runs, Agent):
        out = Path("report.html" if out is None else out)
        return write_page([record(runs, out, [*evaluations])], out)
    paths = [Path(runs)] if isinstance(runs, str | Path) else [Path(run) for run in runs]
    if not 1 <= len(paths) <= MAX_RUNS:
        raise ValueError(f"a report shows 1 to {MAX_RUNS} runs, got {len(paths)}")
    read = [read_run(path) for path in paths]
    if out is None:
        out = read[0].path / "report.html" if len(read) == 1 else Path("report.html")
    return write_page(read, Path(out))


def record(agent: Agent, path: Path, evaluations: Sequence[tuple[int, Evaluation]]) -> RunSummary:
    """Returns the training of an agent so far as a run; ``path`` is only for its name."""
    env = agent.run.env
    history = agent.history
    return RunSummary(
        path=path.absolute(),
        name=path.stem,
        algorithm=agent.name,
        env_id="" if env is None else env.env_id,
        seed=agent.seed,
        n_envs=None if env is None else env.n_envs,
        hyperparameters=configs.to_json(given_config(agent)),
        state="running" if agent.is_learning else "finished",
        steps=agent.run.step,
        seconds=agent.seconds["total"],
        episodes=Episodes.of(Table(history.to_dict())),
        evaluations=evaluation_table(evaluations),
    )


def given_config(agent: Agent) -> Any:
    """Returns the configuration of an agent without the widths of layers that follow from its observations."""
    config = agent.config
    default = type(config)()
    is_default = config.policy_kwargs == configs.with_widths(default, agent.obs_leaves).policy_kwargs
    return dataclasses.replace(config, policy_kwargs=default.policy_kwargs) if is_default else config


def write_page(runs: Sequence[RunSummary], out: Path) -> Path:
    """Writes the page of runs that were read or made, and returns its path."""
    return atomic.write(out, render(runs, out.absolute().parent))


def render(runs: Sequence[RunSummary], folder: Path | None, live: bool = False) -> str:
    """Returns the page as text.

    Args:
        runs: what is shown.
        folder: where the page will be, for links to videos that are not embedded; None for no links.
        live: let the page ask its server for new data.
    """
    parts = sections.build(runs, folder)
    title = sections.title_of(runs)
    return page.render("report.html", parts.data, title=title, runs=parts.runs, live=live)


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
        found = path.lstat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


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
