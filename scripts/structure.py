"""Prints the size of the package and the dependencies between its modules. Uses only the standard library and SciPy.

    python scripts/structure.py [SRC] [--json]

SRC is the folder that contains ``rejeu`` (default: ``src``). The layers are the list under "Layout" in docs/design.md, and the
limits the table under "Size". A line counts if it holds code: not a comment, a docstring or a blank line. Every Python file of
the package counts. Exits with status 1 if there is a cycle, an access to a private attribute, an import against the layers,
two folders that import each other, more lines than a limit, the name of an algorithm as text outside of
:data:`NAMES_ALGORITHMS`, or more placeholders, vague docstrings or ``Any`` than :data:`MAX_PLACEHOLDER_SHARE`,
:data:`MAX_VAGUE_DOCSTRINGS` and :data:`MAX_ANY`.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import re
import sys
import tokenize
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "rejeu"
ENFORCED = ("cycles", "private_accesses", "private_imports", "layering_violations", "both_ways", "over_the_limit")
ENFORCED += ("algorithm_names",)
"""Lists that must be empty."""
PUBLIC_IN_SPITE_OF_ITS_NAME = {"_replace", "_asdict", "_fields", "_field_defaults", "_make", "_exit", "_getframe"}
"""Documented methods of named tuples, and of ``os`` and ``sys``."""
GYMNASIUM_STATE = {"_np_random", "_has_reset", "_elapsed_steps"}
"""Attributes that a snapshot of an environment must contain and that Gymnasium has no public name for."""
LAYOUT = {tokenize.NEWLINE, tokenize.NL, tokenize.COMMENT, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
"""Kinds of token that are not code."""
HANDS_OVER = {("rejeu.agents.agent", "__init__"), ("rejeu.lab.cli.studio", "lab.studio")}
"""An agent writes its report, and shows its environments as the original does, by public names of the package. The command
``studio`` opens the studio, which is a door to all wings as the command line is, and uses it."""
NAMES_ALGORITHMS = {
    "algorithms": "the algorithms themselves, and their catalog",
    "sb3": "names of the original",
    "sb3_contrib": "names of the original",
    "agents.conversion": "what the original's files hold",
    "agents.zip_files": "what the original's files hold",
    "agents.presets": "the default for a kind of action space",
}
"""Where names of algorithms may stand as text, and why; elsewhere they come from ``algorithms/catalog.toml``."""
PLACEHOLDERS = {
    *(
        "one",
        "found",
        "kind",
        "kinds",
        "part",
        "given",
        "made",
        "own",
        "known",
        "what",
        "which",
        "seen",
        "chosen",
        "other",
    ),
    *("rest", "taken", "said", "kept", "left", "place", "answer", "thing", "named", "most", "about"),
}
"""Names that do not say what they hold."""
MAX_PLACEHOLDER_SHARE = 0.5
"""Largest share of placeholders among the names that are bound, in percent. It may only fall."""
MAX_VAGUE_DOCSTRINGS = 10
"""Largest number of docstrings that paraphrase with "what" or begin with "the same". It may only fall."""
MAX_ANY = 1250
"""Largest number of times that ``Any`` stands in the package. It may only fall."""
EXCEPTIONS = PUBLIC_IN_SPITE_OF_ITS_NAME | GYMNASIUM_STATE


def parse(src: Path, package: str = PACKAGE) -> dict[str, tuple[Path, ast.Module]]:
    """Returns path and syntax tree of every module of a package, by dotted name."""
    modules = {}
    for path in sorted((src / package).rglob("*.py")):
        parts = path.relative_to(src).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        modules[name] = path, ast.parse(path.read_text(encoding="utf-8"))
    return modules


def imports(module: str, path: Path, tree: ast.Module, modules: set[str]) -> Iterator[tuple[str, ast.stmt]]:
    """Yields each module of the package that a module imports, anywhere in it, and the statement that does so."""
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package.rsplit(".", node.level - 1)[0] if node.level else ""
            source = ".".join(filter(None, (base, node.module)))
            submodules = {f"{source}.{alias.name}" for alias in node.names}
            names = [*(submodules & modules), *([source] if submodules - modules else [])]
        else:
            continue
        yield from ((name, node) for name in names if name in modules and name != module)


def cycles(edges: dict[str, set[str]]) -> list[list[str]]:
    """Returns the groups of modules that import each other, directly or indirectly."""
    names = sorted(edges)
    number = {name: i for i, name in enumerate(names)}
    pairs = [(number[a], number[b]) for a in names for b in edges[a]]
    rows, columns = zip(*pairs, strict=True)
    graph = coo_array(([1] * len(pairs), (rows, columns)), shape=(len(names), len(names)))
    _, labels = connected_components(graph, connection="strong")
    groups = defaultdict(list)
    for name, label in zip(names, labels, strict=True):
        groups[label].append(name)
    return sorted((group for group in groups.values() if len(group) > 1), key=len, reverse=True)


def is_private(name: str) -> bool:
    """Returns whether a name starts with an underscore and is not a dunder."""
    return name.startswith("_") and not (name.startswith("__") and name.endswith("__"))


def private_accesses(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yields line and text of each ``x._y`` where ``x`` is neither ``self``, ``cls`` nor ``super()``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and is_private(node.attr) and node.attr not in EXCEPTIONS:
            owner = ast.unparse(node.value)
            if owner not in ("self", "cls", "super()"):
                yield node.lineno, f"{owner}.{node.attr}"


def private_imports(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yields line and name of each private name that is imported from a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            yield from ((node.lineno, alias.name) for alias in node.names if is_private(alias.name))


def limits() -> dict[str, int]:
    """Returns the largest number of lines of each folder, from the table under "Size" in docs/design.md."""
    section = (
        (ROOT / "docs" / "design.md").read_text(encoding="utf-8").partition("\n## Size\n")[2].partition("\n## ")[0]
    )
    rows = re.findall(r"^\| `?([\w ]+?)/?`? \| ([\d,]+) \|", section, re.MULTILINE)
    return {name: int(lines.replace(",", "")) for name, lines in rows}


def over_the_limit(lines: Counter[str]) -> list[str]:
    """Returns the limits that are exceeded: of a folder, or of all together."""
    total = lines | Counter(all=sum(lines.values()))
    return [f"{name} has {total[name]:,} lines, its limit is {n:,}" for name, n in limits().items() if total[name] > n]


def layers() -> list[str]:
    """Returns the packages and modules of the list under "Layout" in docs/design.md, in its order."""
    text = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
    listing = re.search(r"## Layout.*?```\nsrc/rejeu/\n(.*?)```", text, re.DOTALL)
    assert listing is not None, 'docs/design.md has no list under "Layout"'
    return [name.replace("/", ".") for name in re.findall(r"^  ([\w/]+?)(?:\.py|/) ", listing[1], re.MULTILINE)]


def layering_violations(module_imports: list[tuple[str, str, int]], order: list[str]) -> list[str]:
    """Returns the imports from a layer further down the list, and modules that are not in the list.

    ``__init__`` may import everything. Only the command line may import from it, and :data:`HANDS_OVER`.
    """
    rank = {name: i for i, name in enumerate(order)} | {"__init__": order.index("lab.cli"), "__main__": len(order)}

    def layer(module: str) -> str:
        parts = module.split(".")[1:] or ["__init__"]
        prefixes = [".".join(parts[:n]) for n in range(len(parts), 0, -1)]
        return next((prefix for prefix in prefixes if prefix in rank), parts[0])

    listed = {layer(name) for name, *_ in module_imports}
    violations = [f"rejeu.{name} is not in the list" for name in sorted(listed - rank.keys())]
    for importer, imported, line in module_imports:
        a, b = layer(importer), layer(imported)
        if a in rank and b in rank and rank[a] < rank[b] and a != "__init__" and (importer, b) not in HANDS_OVER:
            violations.append(f"{importer}:{line} imports {imported}")
    return violations


def both_ways(module_imports: list[tuple[str, str, int]]) -> list[str]:
    """Returns the pairs of rooms, which are the folders of the package, that import each other."""
    arrows = {
        (importer.split(".")[1], imported.split(".")[1])
        for importer, imported, _ in module_imports
        if "." in importer and "." in imported
    }
    return sorted(f"{a} and {b}" for a, b in arrows if a < b and (b, a) in arrows)


def algorithm_names(src: Path, modules: dict[str, tuple[Path, ast.Module]]) -> list[str]:
    """Returns the places outside of :data:`NAMES_ALGORITHMS` where a string is the name of an algorithm."""
    names = tomllib.loads((src / PACKAGE / "algorithms" / "catalog.toml").read_text(encoding="utf-8"))
    allowed = tuple(f"{PACKAGE}.{room}." for room in NAMES_ALGORITHMS)
    return [
        f"{module}:{node.lineno} {node.value}"
        for module, (_, tree) in modules.items()
        if not f"{module}.".startswith(allowed)
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in names
    ]


def bound_names(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yields line and text of each name that is assigned, looped over or a parameter."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg


def vague_docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yields line and first words of each docstring that begins with "what", "Returns what" or "the same"."""
    for node in ast.walk(tree):
        is_text = (
            isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        )
        if is_text and re.match(
            r"(what|(returns|yields) what|(returns |yields )?the same)\b", node.value.value.strip(), re.I
        ):
            yield node.lineno, node.value.value.strip()[:60]


def over_the_share(
    modules: dict[str, tuple[Path, ast.Module]], names: list[str], docstrings: list[str], n_any: int
) -> list[str]:
    """Returns which of the limits of placeholders, of vague docstrings and of ``Any`` is exceeded."""
    n_bound = sum(1 for _, tree in modules.values() for _ in bound_names(tree))
    share = 100 * len(names) / n_bound
    too_many = [f"{share:.2f} % of {n_bound:,} names are placeholders, the limit is {MAX_PLACEHOLDER_SHARE} %"]
    too_vague = [f"{len(docstrings)} docstrings are vague, the limit is {MAX_VAGUE_DOCSTRINGS}"]
    too_open = [f"Any stands {n_any:,} times, the limit is {MAX_ANY:,}"]
    return [
        *too_many * (share > MAX_PLACEHOLDER_SHARE),
        *too_vague * (len(docstrings) > MAX_VAGUE_DOCSTRINGS),
        *too_open * (n_any > MAX_ANY),
    ]


def code_lines(path: Path) -> list[str]:
    """Returns a module's lines that hold code, stripped: those with a token that is not a comment or a docstring."""
    held: set[int] = set()
    statement_begins = True
    with tokenize.open(path) as file:
        text = file.read()
    for token, following in pairwise(tokenize.generate_tokens(io.StringIO(text).readline)):
        if token.type in LAYOUT:
            statement_begins |= token.type == tokenize.NEWLINE
            continue
        is_docstring = statement_begins and token.type == tokenize.STRING and following.type == tokenize.NEWLINE
        if not is_docstring:
            held.update(range(token.start[0], token.end[0] + 1))
        statement_begins = False
    lines = text.splitlines()
    return [lines[n - 1].strip() for n in sorted(held)]


def repeated_lines(files: list[list[str]]) -> tuple[int, int]:
    """Returns the number of lines that occur in three or more of the files, and the number of lines."""
    in_files = Counter(line for file in files for line in set(file))
    lines = [line for file in files for line in file]
    return sum(in_files[line] >= 3 for line in lines), len(lines)


def longest_function(modules: dict[str, tuple[Path, ast.Module]]) -> tuple[int, str]:
    """Returns the number of lines and the name of the longest function."""
    return max(
        (node.end_lineno - node.lineno + 1, f"{name}.{node.name}")
        for name, (_, tree) in modules.items()
        for node in ast.walk(tree)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and node.end_lineno is not None
    )


def mean_function(modules: dict[str, tuple[Path, ast.Module]]) -> float:
    """Returns the mean number of lines of a function, methods and nested functions included."""
    lengths = [
        node.end_lineno - node.lineno + 1
        for _, tree in modules.values()
        for node in ast.walk(tree)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and node.end_lineno is not None
    ]
    return round(sum(lengths) / len(lengths), 1)


def measure(src: Path) -> dict[str, Any]:
    """Returns every count, and the details of those that should be 0."""
    modules = parse(src)
    code: dict[str, list[str]] = {}
    lines: Counter[str] = Counter()
    module_imports = []
    for name, (path, tree) in modules.items():
        parts = path.relative_to(src / PACKAGE).parts
        code[name] = code_lines(path)
        lines[parts[0] if len(parts) > 1 else "top level"] += len(code[name])
        if not path.stem.isidentifier():  # a notebook, which imports what users import
            continue
        module_imports += [(name, imported, node.lineno) for imported, node in imports(name, path, tree, set(modules))]
    edges: dict[str, set[str]] = {name: set() for name in modules}
    for importer, imported, _ in module_imports:
        edges[importer].add(imported)
    algorithms = [code[name] for name in modules if ".algorithms" in name]
    repeated, of = repeated_lines(algorithms)
    length, function = longest_function(modules)
    placeholders = [
        f"{m}:{line} {name}" for m, (_, t) in modules.items() for line, name in bound_names(t) if name in PLACEHOLDERS
    ]
    vague = [f"{m}:{line} {text}" for m, (_, t) in modules.items() for line, text in vague_docstrings(t)]
    n_any = sum(len(re.findall(r"\bAny\b", path.read_text(encoding="utf-8"))) for path, _ in modules.values())
    return {
        "files": len(modules),
        "lines_of_code": sum(lines.values()),
        "lines": sum(len(path.read_text(encoding="utf-8").splitlines()) for path, _ in modules.values()),
        "mean_function": mean_function(modules),
        "lines_by_package": dict(lines.most_common()),
        "top_level_modules": len(list((src / PACKAGE).glob("*.py"))),
        "files_in_agents": len(list((src / PACKAGE / "agents").glob("*.py"))),
        "repeated_lines_in_algorithms": repeated,
        "repeated_share_in_algorithms": round(100 * repeated / of, 1),
        "longest_function": length,
        "longest_function_name": function,
        "cycles": cycles(edges),
        "private_accesses": [
            f"{m}:{line} {text}" for m, (_, t) in modules.items() for line, text in private_accesses(t)
        ],
        "private_imports": [f"{m}:{line} {text}" for m, (_, t) in modules.items() for line, text in private_imports(t)],
        "layering_violations": layering_violations(module_imports, layers()),
        "both_ways": both_ways(module_imports),
        "over_the_limit": over_the_limit(lines) + over_the_share(modules, placeholders, vague, n_any),
        "placeholders": placeholders,
        "vague_docstrings": vague,
        "any": n_any,
        "algorithm_names": algorithm_names(src, modules),
    }


def report(counts: dict[str, Any], verbose: bool) -> None:
    """Prints the counts as text."""
    print(", ".join(f"{package} {n:,}" for package, n in counts["lines_by_package"].items()))
    print(
        f"{counts['lines_of_code']:,} lines that hold code, {counts['lines']:,} lines in {counts['files']} files;",
        f"{counts['top_level_modules']} modules at the top level,",
        end=" ",
    )
    print(f"{counts['files_in_agents']} files in agents/")
    print(f"{counts['repeated_share_in_algorithms']} % of the lines of algorithms/ occur in three or more of its files")
    longest = f"{counts['longest_function_name']} has {counts['longest_function']}"
    print(f"functions: {counts['mean_function']} lines in the mean; {longest}")
    by_room = Counter(entry.split(":")[0].split(".")[1] for entry in counts["placeholders"])
    print(
        f"placeholders: {by_room.total()} ({', '.join(f'{room} {n}' for room, n in by_room.most_common())});", end=" "
    )
    print(f"vague docstrings: {len(counts['vague_docstrings'])}; Any: {counts['any']:,}")
    for key in (*ENFORCED, *(("placeholders", "vague_docstrings") if verbose else ())):
        entries = counts[key]
        sizes = f" of {', '.join(str(len(cycle)) for cycle in entries)} modules" if key == "cycles" and entries else ""
        print(f"{key.replace('_', ' ')}: {len(entries)}{sizes}")
        if verbose or (entries and key in ENFORCED):
            print("".join(f"    {entry if isinstance(entry, str) else ' '.join(entry)}\n" for entry in entries), end="")


def main() -> int:
    """Runs the command and returns its exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("src", nargs="?", type=Path, default=ROOT / "src", help="the folder that contains rejeu")
    parser.add_argument("--json", action="store_true", help="print the counts, and what they count, as JSON")
    parser.add_argument(
        "--verbose", "-v", action="store_true", help="list every access, import and cycle that is counted"
    )
    arguments = parser.parse_args()
    counts = measure(arguments.src)
    if arguments.json:
        print(json.dumps(counts, indent=1))
    else:
        report(counts, arguments.verbose)
    return int(any(counts[key] for key in ENFORCED))


if __name__ == "__main__":
    sys.exit(main())
