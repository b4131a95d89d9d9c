"""The page of all runs below the folder."""

from __future__ import annotations

from fastapi import Request
from nicegui import ui

from rejeu.lab.reporting.rows import COLUMNS, cells
from rejeu.lab.studio.layout import follow
from rejeu.lab.studio.state import Studio


def build(studio: Studio, request: Request) -> None:
    """Makes the table."""
    columns = [{"name": name, "label": name, "field": name, "align": "left", "sortable": True} for name in COLUMNS]
    table = ui.table(rows=[], columns=columns, row_key="run", pagination=50).classes("w-full")

    def show() -> None:
        table.rows = [{"key": row["run"], **cells(row)} for row in studio.rows]
        table.update()

    follow(studio, show)
