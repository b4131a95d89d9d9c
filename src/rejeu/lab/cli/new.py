"""``rejeu new`` writes a project: an environment with its test, a plan of runs, ``pyproject.toml`` and a README."""

from __future__ import annotations

import keyword
import sys
from importlib import resources
from importlib.machinery import PathFinder
from importlib.resources.abc import Traversable
from pathlib import Path

from rejeu.checkpoints.run_folder import check_free
from rejeu.core import atomic
from rejeu.core.types import JsonObject
from rejeu.lab.cli.commands import New
from rejeu.lab.runs.output import echo

NAME = "my_project"
"""The name of the project in the templates, which are the files under ``project``."""


def run_new(arguments: New) -> tuple[int, JsonObject]:
    """Writes the project to a new folder and prints what to do next."""
    folder = arguments.folder
    check_free(folder)
    paths = write(resources.files("rejeu.lab.cli") / "project", folder, package_name(folder))
    for path in paths:
        echo(str(path))
    echo(f"next: cd {folder}; README.md has the commands")
    return 0, {"written": paths}


def package_name(folder: Path) -> str:
    """Returns the name of the Python package for a project in ``folder``.

    Raises:
        ValueError: if it is no name of a package, or that of one that can be imported.
    """
    name = folder.absolute().name.replace("-", "_").lower()
    if not (name.isidentifier() and name.isascii()) or keyword.iskeyword(name):
        raise ValueError(f"{folder.name!r} is no name for a Python package; use letters, digits, - and _")
    if name in ("tests", *sys.stdlib_module_names) or PathFinder.find_spec(name) is not None:
        raise ValueError(f"a Python package {name} exists already; choose another name for the folder")
    return name


def write(template: Traversable, folder: Path, name: str) -> list[Path]:
    """Writes the files under ``template`` to ``folder``, with the project's name in place of ``my_project``."""
    atomic.make_folder(folder)
    paths: list[Path] = []
    for entry in sorted(template.iterdir(), key=lambda entry: entry.name):
        path = folder / entry.name.removesuffix(".txt").replace(NAME, name)
        if entry.is_dir():
            paths += write(entry, path, name)
        else:
            paths.append(atomic.write(path, entry.read_text(encoding="utf-8").replace(NAME, name)))
    return paths
