"""Runs Stable-Baselines3's own tests against rejeu, with the imports replaced, and counts what fails by kind.

    python trials/sb3_suite.py FOLDER --packages SITE_PACKAGES

``FOLDER`` has the tests, such as those in the source distribution of stable-baselines3 2.9.2; they are no part of this
repository. The environments that the original has for them, ``stable_baselines3/common/envs`` beside it, are copied for them
too. ``SITE_PACKAGES`` is searched last, for what rejeu does not need and the tests import, such as PyTorch. Each file
runs in a process of its own. The counts, and each failed test with its kind, are written to
``trials/results/sb3_suite.json``; with ``--log`` the output of pytest to that folder. ``--original`` runs the tests against
Stable-Baselines3 itself, in an interpreter that has it, so that the result says how many tests a file has; of a file that
cannot be imported all count as failed. ``--only`` runs some files and keeps the results of the others, ``--join`` takes those
of other runs over, and each file has the commit that it ran with. The kinds:

- ``tensor``: something of rejeu's was given to PyTorch, or a PyTorch module or optimizer to rejeu.
- ``name``: a module, attribute or argument is missing.
- ``message``: an error or warning of the right class has another text.
- ``absent``: an error or warning is not raised.
- ``package``: a package or an environment is not installed.
- ``time``: the test, or its file, took too long.
- ``difference``: everything else.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path
from typing import Any

from provenance import commit, provenance, read, write

RESULTS = Path(__file__).parent / "results" / "sb3_suite.json"
SOURCES = Path(__file__).resolve().parents[1] / "src"
RENAMED = (
    (r"\bstable_baselines3\.common\.envs\b", "original_envs"),
    (r"\bstable_baselines3\b", "rejeu.sb3"),
    (r"\bsb3_contrib\b", "rejeu.sb3_contrib"),
)
KINDS = (
    ("package", r"No module named '(?!rejeu)|NamespaceNotFound|DependencyNotInstalled|NameNotFound|DeprecatedEnv"),
    ("time", r"Timeout"),
    ("message", r"Regex pattern did not match|Pattern:|DID NOT WARN.*\n(?:.*\n)*?.*Emitted warnings: \[\w*Warning\("),
    ("absent", r"DID NOT (RAISE|WARN)"),
    ("tensor", r"torch|Tensor|\bth\.|nn\.Module|state_dict|FrozenInstanceError"),
    ("name", r"^(ImportError|AttributeError|ModuleNotFoundError|NotImplementedError)|unexpected keyword argument"),
)
"""Kinds with the expressions that identify them in a failure, in order."""
CONFTEST = "import sys\nsys.path += {packages!r}\n"


def kind_of(failure: str) -> str:
    """Returns the kind of a failure: ``failure`` is its last source line and its error."""
    return next(
        (failure_kind for failure_kind, pattern in KINDS if re.search(pattern, failure, re.MULTILINE)), "difference"
    )


def essence(node: ET.Element) -> str:
    """Returns the error of a failed test, and the line of the test that raised it."""
    text = node.text or ""
    lines = [line[1:].strip() for line in text.splitlines() if line.startswith(("E ", ">"))]
    error = "\n".join(line for line in lines if line)
    return "\n".join([node.get("message") or "", error])


def outcomes(report: Path) -> tuple[Counter[str], list[list[str]]]:
    """Returns the numbers of passed, failed and skipped tests, and name and kind of each failed one."""
    counts: Counter[str] = Counter()
    failed = []
    for case in ET.parse(report).getroot().iter("testcase"):
        problem = next((node for node in case if node.tag in ("failure", "error")), None)
        if problem is None:
            counts["skipped" if any(node.tag == "skipped" for node in case) else "passed"] += 1
            continue
        counts["failed"] += 1
        failed.append([case.get("name", ""), kind_of(essence(problem))])
    return counts, failed


def run_file(folder: Path, name: str, limit: float, log: Path | None, n_tests: int) -> dict[str, Any]:
    """Returns the counts of one file of tests, the kinds of its failures, and the failed tests.

    ``n_tests`` is the number of its tests, all of which have failed if it cannot be imported.
    """
    report = folder / "report.xml"
    report.unlink(missing_ok=True)
    options = ["-q", "-p", "no:cacheprovider", f"--junitxml={report}", f"--timeout={limit / 5:.0f}"]
    environment = os.environ | {"PYTHONPATH": str(SOURCES), "MPLBACKEND": "agg"}
    with (log / f"{name}.log" if log else folder / "log").open("w") as output:
        command = [sys.executable, "-m", "pytest", *options, "--timeout-method=signal", name]
        with contextlib.suppress(subprocess.TimeoutExpired):
            subprocess.run(
                command, cwd=folder, env=environment, stdout=output, stderr=output, timeout=limit, check=False
            )
    counts, failed = outcomes(report) if report.is_file() else (Counter({"failed": 1}), [["", "time"]])
    if failed and not counts["passed"] and len(failed) == 1:  # an import, or the file's time
        counts["failed"], failed = n_tests, [["every test", failed[0][1]]]
    numbers = {outcome: counts[outcome] for outcome in ("passed", "failed", "skipped")}
    failure_kinds = Counter(failure_kind for _, failure_kind in failed)
    if failed and failed[0][0] == "every test":
        failure_kinds[failed[0][1]] = n_tests
    return {"file": name, **numbers, "kinds": failure_kinds, "failures": failed}


def total_of(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Returns the sums over files."""
    failure_kinds = sum((Counter(row["kinds"]) for row in rows), Counter())
    return {key: sum(row[key] for row in rows) for key in ("passed", "failed", "skipped")} | {"kinds": failure_kinds}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="the tests")
    parser.add_argument("--packages", nargs="*", default=[], help="folders of packages that are searched last")
    parser.add_argument("--only", nargs="*", help="names of files")
    parser.add_argument("--join", nargs="*", type=Path, default=[], help="other results whose files are taken over")
    parser.add_argument("--limit", type=float, default=1200, help="seconds that a file may take")
    parser.add_argument("--original", action="store_true", help="run them against Stable-Baselines3")
    parser.add_argument("--log", type=Path, help="folder for the output of pytest")
    parser.add_argument("--output", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    if arguments.log:
        arguments.log.mkdir(parents=True, exist_ok=True)
    earlier = read(arguments.output)
    original = earlier.get("original", [])
    tests = {row["file"]: row["passed"] + row["failed"] for row in original}
    joined = [row for path in arguments.join for row in json.loads(path.read_text(encoding="utf-8"))["files"]]
    rows: list[dict[str, Any]] = [*{row["file"]: row for row in joined}.values()]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "tests"
        shutil.copytree(arguments.folder, folder)
        envs = arguments.folder.parent / "stable_baselines3" / "common" / "envs"
        if envs.is_dir() and not arguments.original:
            shutil.copytree(envs, folder / "original_envs")
        for path in folder.rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            for old, new in () if arguments.original else RENAMED:
                text = re.sub(old, new, text)
            path.write_text(text, encoding="utf-8")
        (folder / "conftest.py").write_text(CONFTEST.format(packages=arguments.packages))
        every = sorted(path.name for path in folder.glob("test_*.py"))
        names = every if arguments.only is None else arguments.only
        for name in names:
            rows.append(
                run_file(folder, name, arguments.limit, arguments.log, tests.get(name, 1)) | {"commit": commit()}
            )
            print({key: value for key, value in rows[-1].items() if key != "failures"}, flush=True)
            record(rows, earlier, arguments)
    print(total_of(rows))
    record(rows, earlier, arguments)


def record(rows: list[dict[str, Any]], earlier: dict[str, Any], arguments: argparse.Namespace) -> None:
    """Writes the results so far, with the earlier ones of other files."""
    names = {str(arguments.folder): "FOLDER", str(arguments.log): "LOG", str(arguments.output): "OUTPUT"}
    names |= {str(path): "RESULTS" for path in arguments.join}
    names |= dict.fromkeys(arguments.packages, "SITE_PACKAGES")
    if arguments.original:
        counted = [{key: row[key] for key in ("file", "passed", "failed", "skipped")} for row in rows]
        content = {**earlier, "original": counted, "files": earlier.get("files", [])}
    else:
        other_files = [row for row in earlier.get("files", []) if row["file"] not in {row["file"] for row in rows}]
        files = sorted(other_files + rows, key=lambda row: str(row["file"]))
        original = earlier.get("original", [])
        content = {**provenance(names), "total": total_of(files), "original": original, "files": files}
    write(arguments.output, content, rows="files")


if __name__ == "__main__":
    main()
