"""Pages to keep: the report of a run, and a comparison as a page or as tables, each as one file."""

from __future__ import annotations

from urllib.parse import quote

from fastapi import Request, Response
from nicegui import app

from rejeu.core.errors import expected_errors, one_line
from rejeu.lab.reporting import run_list
from rejeu.lab.reporting.comparison import Comparison
from rejeu.lab.reporting.report import render
from rejeu.lab.studio.compare import choice_of, compared
from rejeu.lab.studio.state import Studio

FORMATS = {"html": Comparison.to_html, "csv": Comparison.to_csv, "curves.csv": Comparison.curves_csv}
"""Endings of files of a comparison, and what they hold."""


def add_downloads(studio: Studio) -> None:
    """Answers requests for files to save. The functions run in threads, and hold up no page."""

    def save_run(run: str) -> Response:
        row = studio.row(run)
        if row is None:
            return Response(status_code=404)
        return attached(render([run_list.read(row.path)]), f"{row.name}.html")

    def save_comparison(request: Request, ending: str) -> Response:
        if ending not in FORMATS:
            return Response(status_code=404)
        try:
            comparison = compared(studio, request.query_params.getlist("run"), choice_of(request))
            return attached(FORMATS[ending](comparison), f"comparison.{ending}")
        except expected_errors() as error:
            return Response(one_line(error), 400, media_type="text/plain")

    app.get("/save/run")(save_run)
    app.get("/save/comparison/{ending}")(save_comparison)


def attached(text: str, name: str) -> Response:
    """Returns a file that the browser saves and does not show."""
    ending = name.rpartition(".")[2]
    header = {"Content-Disposition": f"attachment; filename*=UTF-8''{quote(name)}"}
    return Response(text.encode("utf-8", "replace"), headers=header, media_type=f"text/{ending}; charset=utf-8")
