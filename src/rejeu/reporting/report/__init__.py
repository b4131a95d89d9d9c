"""Reports of runs: one HTML page that needs no network, with curves, tables, videos and the command that repeats the run.

Everything in a run folder is untrusted. Jinja2 escapes all text, JSON is escaped for scripts, and the page's
Content-Security-Policy allows its own scripts by a random nonce and nothing from elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rejeu.io import atomic
from rejeu.reporting.report import page, sections
from rejeu.reporting.runs import Run, read_run

MAX_RUNS = 50
"""Most runs of a page."""


def write_report(runs: str | Path | Sequence[str | Path], out: str | Path | None = None) -> Path:
    """Writes the report of one or several runs as one HTML page, and returns its path.

    Args:
        runs: run folders.
        out: file to write; None for ``report.html`` in the folder of a single run, or in the current folder.

    Raises:
        FileNotFoundError: if a folder does not exist, or holds nothing of a run.
        MissingExtra: if plotly or jinja2 is not installed.
        ValueError: for no run, or more than ``MAX_RUNS``.
    """
    paths = [Path(runs)] if isinstance(runs, str | Path) else [Path(run) for run in runs]
    if not 1 <= len(paths) <= MAX_RUNS:
        raise ValueError(f"a report shows 1 to {MAX_RUNS} runs, got {len(paths)}")
    read = [read_run(path) for path in paths]
    if out is None:
        out = read[0].path / "report.html" if len(read) == 1 else Path("report.html")
    return write_page(read, Path(out))


def write_page(runs: Sequence[Run], out: Path) -> Path:
    """Writes the page of runs that were read or made, and returns its path."""
    return atomic.write(out, render(runs, out.absolute().parent))


def render(runs: Sequence[Run], folder: Path | None, live: bool = False) -> str:
    """Returns the page as text.

    Args:
        runs: what is shown.
        folder: where the page will be, for links to videos that are not embedded; None for no links.
        live: let the page ask its server for new data.
    """
    parts = sections.build(runs, folder)
    title = sections.title_of(runs)
    return page.render("report.html", parts.data, title=title, runs=parts.runs, live=live)
