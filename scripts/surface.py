"""Compares what users see of two checkouts: commands, options, public names, parameters, and the examples of the pages.

    python scripts/surface.py ../before             # exits with status 1 if something of the other checkout is missing here
    python scripts/surface.py ../before --examples  # also runs the examples and commands of its pages with this package
    python scripts/surface.py --record FILE         # writes this surface as JSON, which may stand for a checkout

Names are those of ``rejeu``, of every module of ``rejeu.sb3``, those in docs/api, and those that a page or an example of
the other checkout imports. Help texts may be worded anew: those that changed are listed and are no error.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import json
import os
import pkgutil
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DIRECTIVE = re.compile(r"^\.\. auto(\w+):: ([\w.]+)(.*(?:\n   .+)*)", re.MULTILINE)
IMPORT = re.compile(r"^\s*(?:>>> )?from (rejeu[\w.]*) import \(?([\w, ]+)", re.MULTILINE)


def command(*words: str) -> str:
    """Returns what ``rejeu`` prints."""
    wide = {**os.environ, "COLUMNS": "120", "NO_COLOR": "1"}
    return subprocess.run([sys.executable, "-m", "rejeu", *words], capture_output=True, text=True, env=wide).stdout


def helps() -> dict[str, str]:
    """Returns the help of every command, and of ``rejeu`` itself under the name "rejeu"."""
    whole = command("--help")
    listed = re.search(r"\{([\w,]+)\}", whole)
    names = listed[1].split(",") if listed else re.findall(r"^ {2,4}([a-z]+)(?:  |$)", whole, re.MULTILINE)
    return {"rejeu": whole, **{name: command(name, "--help") for name in names}}


def options(text: str) -> list[str]:
    """Returns the options and positional arguments in a help text, in a box or not."""
    matches = re.findall(r"^(?:│ |  )(?:-\w, )?(--[\w-]+)", text, re.MULTILINE)
    return sorted({*matches, *re.findall(r"^(?:│ |  )([A-Z_]+)(?:  |$)", text, re.MULTILINE)})


def documented(root: Path) -> set[str]:
    """Returns the dotted names in the API reference and in the imports of the pages and examples of a checkout."""
    names = set()
    for path in (root / "docs" / "api").glob("*.rst"):
        for directive, name, more in DIRECTIVE.findall(path.read_text(encoding="utf-8")):
            listed = re.search(r":members: (.+)", more)
            members = listed[1].split(", ") if listed else []
            names |= {f"{name}.{member}" for member in members} | ({name} if directive != "module" else set())
            if directive == "module" and not members:
                module = importlib.import_module(name)
                names |= {f"{name}.{key}" for key in public(module) if is_own(module, key)}
    for path in [root / "README.md", *(root / "docs").rglob("*.md"), *(root / "examples").rglob("*.py")]:
        for module, imported in IMPORT.findall(path.read_text(encoding="utf-8")):
            names |= {f"{module}.{name.split(' as ')[0].strip()}" for name in imported.split(",") if name.strip()}
    return names


def with_methods(names: set[str], root: Path) -> set[str]:
    """Returns the names, and those of the methods of agents, of ``rejeu.sb3`` and of classes whose members are documented."""
    reference = "".join(path.read_text(encoding="utf-8") for path in (root / "docs" / "api").glob("*.rst"))
    listed = {name for _, name, more in DIRECTIVE.findall(reference) if re.search(r":members:$", more, re.MULTILINE)}
    excluded = {name for names in re.findall(r":exclude-members: (.+)", reference) for name in names.split(", ")}
    agent = pkgutil.resolve_name("rejeu.agents.Agent")
    all_names = set(names)
    for name in names:
        value = pkgutil.resolve_name(name)
        is_listed = (
            name in listed or name.startswith("rejeu.sb3") or (inspect.isclass(value) and issubclass(value, agent))
        )
        if inspect.isclass(value) and is_listed:
            methods = {key for key in dir(value) if key[0] != "_" and is_rejeu(getattr(value, key, None))}
            all_names |= {f"{name}.{key}" for key in methods - excluded}
    return all_names


def public(module: Any) -> list[str]:
    """Returns the public names of a module."""
    return sorted(getattr(module, "__all__", [name for name in vars(module) if not name.startswith("_")]))


def is_own(module: Any, name: str) -> bool:
    """Returns whether a module defines a name itself."""
    return getattr(getattr(module, name), "__module__", None) == module.__name__


def surface(root: Path) -> dict[str, Any]:
    """Returns the commands and, by dotted name, the parameters of public classes and functions."""
    import rejeu
    import rejeu.sb3

    names = documented(root) | {f"rejeu.{name}" for name in rejeu.__all__}
    for info in pkgutil.walk_packages(rejeu.sb3.__path__, "rejeu.sb3."):
        module = importlib.import_module(info.name)
        names |= {f"{info.name}.{name}" for name in public(module) if is_rejeu(getattr(module, name))}
    texts = helps()
    return {
        "helps": texts,
        "options": {name: options(text) for name, text in texts.items()},
        "names": {name: parameters(name) for name in sorted(with_methods(names, root))},
    }


def is_rejeu(value: Any) -> bool:
    """Returns whether a class or function is defined in the package."""
    return callable(value) and str(getattr(value, "__module__", "")).startswith("rejeu")


def parameters(name: str) -> list[str] | None:
    """Returns the names of the parameters, None of a value that cannot be called; raises an error if there is no such name."""
    value = pkgutil.resolve_name(name)
    try:
        return [key for key in inspect.signature(value).parameters if key != "self"] if callable(value) else None
    except ValueError:
        return None


def of_checkout(path: Path) -> dict[str, Any]:
    """Returns the surface of another checkout, or the one recorded in a file."""
    if path.is_file():
        return json.loads(path.read_text(encoding="utf-8"))
    environment = {**os.environ, "PYTHONPATH": str(path / "src")}
    words = [sys.executable, __file__, "--record", "-", "--root", str(path)]
    return json.loads(subprocess.run(words, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout)


def missing(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Returns a line for each command, option, name and parameter that is not here any more."""
    lines = []
    for name, recorded_options in before["options"].items():
        if name not in now["options"]:
            lines.append(f"command {name}")
        lines += [
            f"{name} {option}"
            for option in recorded_options
            if option not in now["options"].get(name, recorded_options)
        ]
    for name, recorded_parameters in before["names"].items():
        try:
            here = parameters(name)
        except (ImportError, AttributeError) as error:
            lines.append(f"{name}: {error}")
            continue
        if recorded_parameters and here is not None and not any(key in ("kwargs", "hyperparameters") for key in here):
            lines += [f"{name}({key})" for key in recorded_parameters if key not in here]
    return lines


def run_examples(root: Path) -> int:
    """Runs the examples and commands of the pages of another checkout with this package; returns pytest's exit status."""
    words = [sys.executable, "-m", "pytest", "tests/test_docs.py", "-k", "examples_of_a_page or commands_of_a_page"]
    return subprocess.run(words, env={**os.environ, "REJEU_PAGES": str(root.resolve())}, cwd=ROOT).returncode


def main() -> int:
    """Runs the command and returns its exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("before", nargs="?", type=Path, help="another checkout, or a file that was recorded there")
    parser.add_argument("--examples", action="store_true", help="run the examples of the other checkout too")
    parser.add_argument("--record", metavar="FILE", help="write what is here to this file, - for standard output")
    parser.add_argument("--root", type=Path, default=ROOT, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    now = surface(arguments.root)
    if arguments.record:
        text = json.dumps(now, indent=1) + "\n"
        sys.stdout.write(text) if arguments.record == "-" else Path(arguments.record).write_text(text, encoding="utf-8")
    if not arguments.before:
        return 0
    before = of_checkout(arguments.before)
    reworded = [name for name, text in before["helps"].items() if now["helps"].get(name) != text]
    print(f"{len(before['options'])} commands, {sum(map(len, before['options'].values()))} options,", end=" ")
    print(f"{len(before['names'])} names; help reworded: {', '.join(reworded) or 'none'}")
    lost = missing(before, now)
    print(*(f"missing: {line}" for line in lost), f"{len(lost)} missing", sep="\n")
    failed = run_examples(arguments.before) if arguments.examples else 0
    return int(bool(lost or failed))


if __name__ == "__main__":
    sys.exit(main())
