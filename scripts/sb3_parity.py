"""The tables of docs/coming-from-sb3.md: names, examples, tests and results beside Stable-Baselines3's.

    python scripts/sb3_parity.py record    # where stable-baselines3 and sb3-contrib are installed
    python scripts/sb3_parity.py           # prints the comparison of names

``record`` writes the public classes and functions of each module, with their arguments and methods, to
``tests/data/sb3/signatures.json``, and to ``visible_names.json`` beside it the other names that each module exports: its
constants and types, and the names of other modules of the packages that it passes on. Names that begin with an underscore
are left out, and so are type variables.
"""

from __future__ import annotations

import ast
import enum
import importlib
import inspect
import json
import pkgutil
import re
import statistics
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "tests" / "data" / "sb3" / "signatures.json"
VISIBLE = DATA.with_name("visible_names.json")
GUIDE = ROOT / "trials" / "results" / "sb3_guide.json"
FRAGMENT = "NameError|SyntaxError"
"""Errors of blocks that are a part of a program."""
PACKAGES = {"stable_baselines3": "rejeu.sb3", "sb3_contrib": "rejeu.sb3_contrib"}
"""The original's packages, and where their names are here."""


def arguments_of(function: Any) -> list[str]:
    """Returns the names of the arguments of a function or of a class, without those for any number of arguments."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return []
    any_number = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return [parameter.name for parameter in parameters if parameter.kind not in any_number and parameter.name != "self"]


def modules_of(package: str) -> Iterator[ModuleType]:
    """Yields an installed package and its modules."""
    parent = importlib.import_module(package)
    yield parent
    for info in pkgutil.walk_packages(parent.__path__, f"{package}."):
        try:
            yield importlib.import_module(info.name)
        except ImportError:  # of something optional
            continue


def recorded() -> dict[str, Any]:
    """Returns the public classes and functions of the installed packages, by module."""
    signatures: dict[str, Any] = {}
    for package in PACKAGES:
        for module in modules_of(package):
            definitions = {
                key: described(value, package)
                for key, value in vars(module).items()
                if callable(value) and not key.startswith("_") and getattr(value, "__module__", None) == module.__name__
            }
            if definitions:
                signatures[module.__name__] = definitions
    return signatures


def visible() -> dict[str, list[str]]:
    """Returns the names that can be imported from each module of the installed packages, without those of third parties."""
    return {module.__name__: sorted({*bound_by(module)}) for package in PACKAGES for module in modules_of(package)}


def bound_by(module: ModuleType) -> Iterator[str]:
    """Yields the public names that the code of a module defines, or imports from the packages."""
    for node in ast.walk(ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.Module | ast.If | ast.Try):
            statements = [*node.body, *getattr(node, "orelse", ())]
            names += [node.name for node in statements if isinstance(node, ast.FunctionDef | ast.ClassDef)]
            targets = [target for node in statements if isinstance(node, ast.Assign) for target in node.targets]
            names += [target.id for target in targets if isinstance(target, ast.Name)]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] in PACKAGES:
            names += [alias.asname or alias.name for alias in node.names]
        for name in names:
            value = getattr(module, name, None)
            if not name.startswith("_") and value is not None and not isinstance(value, ModuleType | TypeVar):
                yield name


def described(definition: Any, package: str) -> dict[str, list[str]]:
    """Returns the arguments and, of a class, the methods that the package defines."""
    if not inspect.isclass(definition):
        return {"arguments": arguments_of(definition)}
    bases = [base for base in definition.__mro__ if base.__module__.startswith(package)]
    methods = {key for base in bases for key, method in vars(base).items() if inspect.isroutine(method)}
    return {"arguments": arguments_of(definition), "methods": sorted(key for key in methods if not key.startswith("_"))}


def accepted(definition: Any) -> set[str]:
    """Returns the arguments that a class or function of rejeu takes by name."""
    from rejeu.checkpoints.agent_state import AGENT_ARGUMENTS
    from rejeu.core import validation
    from rejeu.sb3 import algorithms, arguments

    names = set(arguments_of(definition))
    if inspect.isclass(definition) and issubclass(definition, algorithms.Original):
        names |= {*validation.field_names(definition.algorithm.Config), *AGENT_ARGUMENTS}
        names |= {*arguments.WITHOUT_EFFECT, *arguments.NEUTRAL}
    return names


def takes_any(definition: Any) -> bool:
    """Returns whether a function passes arguments of any name on, or depends on Python's version, as of enumerations."""
    if inspect.isclass(definition) and issubclass(definition, enum.Enum):
        return True
    try:
        parameter_kinds = [parameter.kind for parameter in inspect.signature(definition).parameters.values()]
    except (TypeError, ValueError):
        return True
    return inspect.Parameter.VAR_KEYWORD in parameter_kinds


def compared() -> tuple[dict[str, tuple[int, int, list[str]]], dict[str, set[str]], dict[str, set[str]]]:
    """Returns the counts of names and the missing ones, by module; and the owners of each lacking argument and method."""
    from rejeu.sb3 import algorithms

    modules: dict[str, tuple[int, int, list[str]]] = {}
    arguments: dict[str, set[str]] = {}
    methods: dict[str, set[str]] = {}
    for path, names in json.loads(DATA.read_text(encoding="utf-8")).items():
        package = path.partition(".")[0]
        here = PACKAGES[package] + path[len(package) :]
        try:
            module: Any = importlib.import_module(here)
        except ModuleNotFoundError:
            module = None
        missing = [name for name in names if not hasattr(module, name)]
        modules[here] = len(names) - len(missing), len(names), missing
        for name in names.keys() - {*missing}:
            definition, original = getattr(module, name), names[name]
            is_agent = inspect.isclass(definition) and issubclass(definition, algorithms.Original)
            for key in original["arguments"] if is_agent or not takes_any(definition) else ():
                if key not in accepted(definition):
                    arguments.setdefault(key, set()).add(name)
            for key in original.get("methods", ()):
                if inspect.isclass(definition) and not hasattr(definition, key):
                    methods.setdefault(key, set()).add(name)
    return modules, arguments, methods


def importable() -> dict[str, list[tuple[str, bool]]]:
    """Returns the modules that have each name in the original, and whether it can be imported from them here."""
    modules: dict[str, list[tuple[str, bool]]] = {}
    for path, names in json.loads(VISIBLE.read_text(encoding="utf-8")).items():
        package = path.partition(".")[0]
        here = PACKAGES[package] + path[len(package) :]
        try:
            module: Any = importlib.import_module(here)
        except ModuleNotFoundError:
            module = None
        for name in names:
            modules.setdefault(name, []).append((here, hasattr(module, name)))
    return modules


def names_of(lacking: dict[str, set[str]]) -> str:
    """Returns the lacking names, each with a class or function that lacks it and the number of others."""
    shown = []
    for key, owners in sorted(lacking.items()):
        more = f" and {len(owners) - 1} more" if len(owners) > 1 else ""
        shown.append(f"`{key}` ({min(owners)}{more})")
    return ", ".join(shown)


def text() -> str:
    """Returns the comparison for the documentation."""
    modules, arguments, methods = compared()
    n, of = (sum(row[i] for row in modules.values()) for i in (0, 1))
    complete = f"{sum(not row[2] for row in modules.values())} of {len(modules)} modules are complete, all but these"
    lines = [f"{n} of {of} public classes and functions are where the original has them. {complete}:", ""]
    lines += ["| module | names | missing |", "|---|---|---|"]
    for path, (there, total, missing) in modules.items():
        if missing:
            lines.append(f"| `{path}` | {there} of {total} | {', '.join(f'`{name}`' for name in missing)} |")
    visible_names = importable()
    present = [has for modules_with_it in visible_names.values() for _, has in modules_with_it]
    nowhere = sorted(
        name for name, modules_with_it in visible_names.items() if not any(has for _, has in modules_with_it)
    )
    lines += [
        "",
        f"{sum(present)} of {len(present)} names, with constants, types and those that a module passes on, can be "
        f"imported from the modules where the original has them. In no module are "
        f"{', '.join(f'`{name}`' for name in nowhere)}.",
        "",
        f"Arguments that are not taken: {names_of(arguments)}.",
        "",
        f"Methods that are missing: {names_of(methods)}.",
    ]
    return "\n".join(lines)


def guide() -> str:
    """Returns how many blocks of code of the original's documentation run here as there, for the documentation."""
    content = json.loads(GUIDE.read_text(encoding="utf-8"))
    tried = [row for row in content["blocks"] if "rejeu" in row]
    plain = [row for row in tried if not row["torch"]]
    alike, others = (sum(not row["differs"] for row in rows) for rows in (plain, tried))
    n, n_not_run = len(content["blocks"]), len(content.get("not_run", ()))
    lines = [
        f"{alike} of {len(plain)} blocks without PyTorch do the same as with the original, and {others - alike} of the "
        f"{len(tried) - len(plain)} with it. The original does not run the other {n - len(tried)} of {n}: they are "
        f"pseudocode, or packages or time lack{f'; {n_not_run} have not been tried' * (n_not_run > 0)}. These differ:",
        "",
    ]
    for row in tried:
        if row["differs"]:
            text = "; ".join(row["differs"][:2]).replace("|", "/").replace("<", "").replace(">", "")
            lines.append(f"- {row['block']}{', with PyTorch' * row['torch']}: `{text.replace(' - ', ', here ')[:150]}`")
    raising = [row["block"] for row in tried if row["original"]["error"] and row["rejeu"]["error"]]
    fragments = [row["block"] for row in content["blocks"] if re.match(FRAGMENT, row["original"]["error"] or "")]
    lines += ["", f"With both these raise, most on purpose: {', '.join(raising)}."]
    lines += ["", f"Fragments, which name what they do not define: {', '.join(fragments)}."]
    return "\n".join(lines)


def suite(length: str = "") -> str:
    """Returns how the original's own tests end here; ``short`` leaves the files out."""
    content = json.loads((ROOT / "trials" / "results" / "sb3_suite.json").read_text(encoding="utf-8"))
    if not content["files"]:
        raise FileNotFoundError("the tests were not run")
    passed, total = content["total"]["passed"], content["total"]["passed"] + content["total"]["failed"]
    without = total - content["total"]["kinds"].get("tensor", 0)
    share = f"{passed} of {total} tests pass; without those that need tensors of PyTorch, {passed} of {without}"
    share += f" ({passed / without:.1%}). The others are {counted(content['total']['kinds'])}."
    if length == "short":
        return share
    original = {row["file"]: row["passed"] for row in content["original"]}
    lines = ["| file | original passes | passes here | fails here | commit |", "|---|---|---|---|---|"]
    for row in content["files"]:
        cells = row["file"].removesuffix(".py"), str(original[row["file"]]), str(row["passed"]), counted(row["kinds"])
        lines.append(f"| {' | '.join(cells)} | {row['commit'][:7]} |")
    return "\n".join([share, "", f"{content['date']}, `{content['command']}`", "", *lines])


def counted(failures: dict[str, int]) -> str:
    """Returns numbers of failures by kind, the most frequent first."""
    return ", ".join(f"{count} {failure}" for failure, count in sorted(failures.items(), key=lambda item: -item[1]))


def same_scripts() -> str:
    """Returns the table of mean returns of one script with either library, for the documentation."""
    from trials.provenance import half_interval, read

    folder = ROOT / "benchmarks" / "results" / "sb3_scripts"
    runs = {name: read(folder / f"{name}.json")["runs"] for name in ("original", "rejeu")}
    lines = ["| | task | steps | seeds | Stable-Baselines3 | rejeu |", "|---|---|---|---|---|---|"]
    apart = []
    for algorithm in dict.fromkeys(run["algorithm"] for run in runs["rejeu"]):
        shown, limits = [], []
        for rows in runs.values():
            algorithm_runs = [run for run in rows if run["algorithm"] == algorithm]
            values = [run["mean_return"] for run in algorithm_runs]
            mean, half = statistics.mean(values), half_interval(values)
            limits.append((mean - half, mean + half))
            shown.append(f"{mean:.1f} [{mean - half:.1f}, {mean + half:.1f}]")
        apart += [algorithm] * (max(low for low, _ in limits) > min(high for _, high in limits))
        first = f"| {algorithm} | {algorithm_runs[0]['env_id']} | {algorithm_runs[0]['steps']:,} | {len(values)} |"
        lines.append(f"{first} {' | '.join(shown)} |")
    overlap = f"Intervals do not overlap: {', '.join(apart)}." if apart else "All intervals overlap."
    return "\n".join([*lines, "", overlap])


if __name__ == "__main__":
    if sys.argv[1:] == ["record"]:
        for path, content in ((DATA, recorded()), (VISIBLE, visible())):
            rows = ",\n".join(f"{json.dumps(name)}: {json.dumps(value)}" for name, value in content.items())
            path.write_text(f"{{\n{rows}\n}}\n", encoding="utf-8")
    else:
        print(text())
