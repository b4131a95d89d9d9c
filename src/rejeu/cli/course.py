"""``rejeu course``: the notebooks of the courses, written to a folder."""

from __future__ import annotations

from pathlib import Path

from rejeu.cli import jsonout
from rejeu.cli.commands import Course
from rejeu.courses import write


def run(arguments: Course) -> int:
    """Writes the notebooks, prints a line for each file, and returns the exit status."""
    written: list[Path] = []
    kept: list[Path] = []
    with jsonout.messages(arguments.json) as output:
        for path, is_new in write(arguments.language, arguments.folder):
            (written if is_new else kept).append(path)
            change = "" if is_new else " exists and was not changed; delete or rename it to get a new copy"
            print(f"{path}{change}", flush=True)
        if not any(path.suffix == ".ipynb" for path in [*written, *kept]):
            print('only text notebooks (.py) were written; for .ipynb too, run: pip install "rejeu[course]"')
        if arguments.json:
            jsonout.emit({"written": written, "kept": kept}, output)
    return 0
