"""Prints the test files of a change, which ``scripts/test --changed`` runs.

    python scripts/changed.py [COMMIT] [--files FILE ...]

The change is the difference from COMMIT (default: ``main``), including uncommitted files. The tests of a changed module are
the files that have its name, and those that import it, directly or through modules of ``tests``. If there are none, they are
those of the modules that import it, and so on. A test file that has changed is one of them. So are all tests of a folder in
:data:`SERVED`, whose modules run in a process that tests start.
"""

from __future__ import annotations

import argparse
import ast
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from structure import imports, parse  # beside this file

ROOT = Path(__file__).resolve().parents[1]
SERVED = {"rejeu.lab.studio": "tests.lab.studio"}
"""Folders of modules that tests reach by a server in another process, and the folders of these tests."""
DISPATCHING = {"rejeu.algorithms.ddpg", "rejeu.algorithms.sac"}
"""Packages whose ``make`` chooses one of their modules by the spaces. Tests of such a module call it by its package."""


def definitions(modules: dict[str, tuple[Path, ast.Module]]) -> dict[tuple[str, str], str]:
    """Returns the module behind each name that a module imports from another one, for example behind ``rejeu.SAC``."""
    return {
        (module, alias.asname or alias.name): source
        for module, (path, tree) in modules.items()
        for source, node in imports(module, path, tree, set(modules))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    } | {
        ("rejeu", alias.name): node.module
        for node in ast.walk(modules["rejeu"][1])
        if isinstance(node, ast.ImportFrom) and node.module in modules
        for alias in node.names
    }


def used(
    module: str, path: Path, tree: ast.Module, modules: set[str], behind: dict[tuple[str, str], str]
) -> Iterator[str]:
    """Yields each module that a test file imports, with those behind the names that it takes from packages."""
    for source, node in imports(module, path, tree, modules):
        yield source
        if isinstance(node, ast.ImportFrom):
            yield from (behind[source, alias.name] for alias in node.names if (source, alias.name) in behind)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and ("rejeu", node.attr) in behind and ast.unparse(node.value) == "rejeu":
            yield behind["rejeu", node.attr]


def reached(start: Iterable[str], edges: dict[str, set[str]]) -> set[str]:
    """Returns the names that can be reached, with those at the start."""
    names, queue = set(start), list(start)
    while queue:
        new = edges[queue.pop()] - names
        names |= new
        queue += new
    return names


class Graph(NamedTuple):
    """What imports what."""

    paths: dict[str, str]
    """Modules of the package and of the tests by their path below the repository."""
    needs: dict[str, set[str]]
    """What each test file imports, directly or through modules of ``tests``, and itself."""
    importers: dict[str, set[str]]
    """The modules of the package that import a module."""


@cache
def graph() -> Graph:
    """Reads all files once."""
    package, tests = parse(ROOT / "src"), parse(ROOT, "tests")
    behind, modules = definitions(package), {*package, *tests}
    edges: dict[str, set[str]] = defaultdict(set)
    for name, (path, tree) in tests.items():
        edges[name] = set(used(name, path, tree, modules, behind))
    importers: dict[str, set[str]] = defaultdict(set)
    for name, (path, tree) in package.items():
        for source, _ in imports(name, path, tree, set(package)):
            importers[source].add(name)
    within_tests = defaultdict(set, {name: sources & tests.keys() for name, sources in edges.items()})
    needs = {
        name: set[str]().union(*(edges[module] for module in reached([name], within_tests))) | {name}
        for name in tests
        if name.rpartition(".")[2].startswith("test_")
    }
    return Graph(
        {path.relative_to(ROOT).as_posix(): name for name, (path, _) in (package | tests).items()}, needs, importers
    )


def tests_of(changed: Iterable[str]) -> list[str]:
    """Returns the test files of changed files, as paths below the repository, sorted."""
    paths, needs, importers = graph()
    selected: set[str] = set()
    for module in (paths[file] for file in changed if file in paths):
        selected |= {name for name in needs if f"test_{module.rpartition('.')[2]}" == name.rpartition(".")[2]}
        package = {module.rpartition(".")[0]}
        ring = {module} | (package if package <= importers[module] & DISPATCHING else set())
        visited = set(ring)
        while ring and not (of_ring := {name for name, modules in needs.items() if modules & ring}):
            ring = set[str]().union(*(importers[importer] for importer in ring)) - visited
            visited |= ring
        selected |= of_ring if ring else set()
        served = SERVED.get(module.rpartition(".")[0])
        selected |= {name for name in needs if name.rpartition(".")[0] == served}
    return sorted(path for path, name in paths.items() if name in selected)


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("commit", nargs="?", default="main", help="compare with this commit")
    parser.add_argument("--files", nargs="+", help="these files instead, as paths below the repository")
    arguments = parser.parse_args()
    git = ["git", "-C", str(ROOT)]
    commands = [[*git, "diff", "--name-only", arguments.commit], [*git, "ls-files", "--others", "--exclude-standard"]]
    changed = arguments.files or [
        line for command in commands for line in subprocess.check_output(command, text=True).splitlines()
    ]
    print("\n".join(tests_of(changed)))


if __name__ == "__main__":
    sys.exit(main())
