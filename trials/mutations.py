"""Planted bugs: single lines of the package are changed, and the default tests must notice each of them.

Run it with the active python::

    python trials/mutations.py                      # all that are not in the table yet
    python trials/mutations.py --only td3 --again   # those whose file or name contains the text, also known ones
    python trials/mutations.py --check              # only whether every line that is changed is still there
    python trials/mutations.py --stages 1           # only the tests of the changed file
    python trials/mutations.py --together           # those that this missed: all of them at once, then one by one

Each mutation is made in a copy of the tracked files, and the default tests run there with ``pytest -x``: first the test that
the table names, then the files that ``scripts/changed.py`` finds for the change, then all. The first test that fails is
written beside the bug to ``trials/results/mutations.json``, from which the page "How we check" has its table. A mutation that
no test notices is *missed*. The lines are in ``trials/mutations.toml``. One that no longer occurs exactly once stops the
script before anything runs.

The wider tests take long where most bugs are caught by the nearest ones. With ``--together`` they run once, without ``-x``,
on a copy with all changes that are known as missed; the tests that fail there then run with each change alone.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "scripts"))

from changed import tests_of  # noqa: E402  # a script, which is in no package

RESULTS = ROOT / "trials" / "results" / "mutations.json"
COPIED = ("src", "tests", "scripts", "examples", "docs", "benchmarks", "trials")
LIMIT = 1200
"""Seconds for the tests of one stage."""


class Mutation(NamedTuple):
    """One line that is changed."""

    file: str
    """Below ``src/rejeu``."""
    old: str
    """Occurs once in the file."""
    new: str
    kind: str
    room: str | None = None
    """The part of the package, of a bug outside of algorithms, buffers and loops."""
    at_first: str | None = None
    """``caught`` or ``missed``: what the tests did at first, of a bug by someone who had not read them."""


MUTATIONS = [
    Mutation(**entry)
    for entry in tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))["mutation"]
]
"""The lines and what takes their place."""


def stages(mutation: Mutation) -> list[list[str]]:
    """Returns the tests to run one after the other: those of the changed file, then all."""
    return [tests_of([f"src/rejeu/{mutation.file}"]), ["tests"]]


def check() -> None:
    """Stops the script if a line that is to be changed does not occur exactly once."""
    gone = []
    for mutation in MUTATIONS:
        path = ROOT / "src/rejeu" / mutation.file
        n = path.read_text(encoding="utf-8").count(mutation.old) if path.exists() else 0
        if n != 1:
            gone.append(f"{mutation.file}: {n} times: {mutation.old}")
    if gone:
        sys.exit("these lines do not occur exactly once; change trials/mutations.toml:\n" + "\n".join(gone))


def copied(folder: Path) -> None:
    """Copies what tests need."""
    for name in COPIED:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ROOT.glob("*.*"):
        if file.is_file():
            shutil.copy(file, folder / file.name)


def pytest(tests: Sequence[str], folder: Path, limit: float, *options: str) -> subprocess.CompletedProcess[str]:
    """Runs tests in ``folder``.

    Raises:
        subprocess.TimeoutExpired: after ``limit`` seconds.
    """
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(folder / "src"), str(folder)]),
        "JAX_PLATFORMS": "cpu",
    }
    command = [sys.executable, "-m", "pytest", "-q", "--no-header", "-p", "no:cacheprovider", *options, *tests]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=limit)


def failed(output: str) -> list[str]:
    """Returns the tests that failed, with their parameters."""
    return re.findall(r"^(?:FAILED|ERROR) (\S+?(?:\[.*?\])?)(?: - .*)?$", output, re.MULTILINE)


@contextmanager
def planted(mutations: Sequence[Mutation], folder: Path) -> Iterator[None]:
    """Makes changes in ``folder``, and takes them back."""
    texts: dict[Path, str] = {}
    try:
        for mutation in mutations:
            path = folder / "src/rejeu" / mutation.file
            text = path.read_text(encoding="utf-8")
            texts.setdefault(path, text)
            path.write_text(text.replace(mutation.old, mutation.new), encoding="utf-8")
        yield
    finally:
        for path, text in texts.items():
            path.write_text(text, encoding="utf-8")


def as_row(mutation: Mutation) -> dict[str, object]:
    """Returns a row of the table of a mutation that no test has noticed yet."""
    return {name: value for name, value in mutation._asdict().items() if value is not None} | {
        "caught_by": None,
        "stage": None,
    }


def run(mutation: Mutation, folder: Path, n_stages: int, limit: float) -> dict[str, object]:
    """Makes the change in ``folder``, runs the tests, takes it back, and returns a row of the table."""
    row, began, done = as_row(mutation), time.monotonic(), list[str]()
    numbered = [*enumerate(stages(mutation)[:n_stages], 1)]
    earlier = table().get(key(mutation), row)
    if earlier["caught_by"] is not None and "::" in earlier["caught_by"]:
        numbered.insert(0, (earlier["stage"], [earlier["caught_by"]]))
    with planted([mutation], folder):
        for number, tests in numbered:
            tests = [test for test in tests if test not in done]
            done += tests
            if not tests:
                continue
            try:
                ended = pytest(tests, folder, limit, "-x")
            except subprocess.TimeoutExpired:
                row |= {"caught_by": f"no end after {limit:g} s", "stage": number}
                break
            if ended.returncode in (1, 2):  # 2: a file of tests cannot be imported
                failures = failed(ended.stdout)
                row |= {"caught_by": failures[0].partition("[")[0] if failures else "?", "stage": number}
                break
            if ended.returncode not in (0, 4, 5):  # 4 and 5: there is no such test
                sys.exit(
                    f"pytest ended with {ended.returncode} on {mutation}:\n{ended.stdout[-2000:]}{ended.stderr[-2000:]}"
                )
    return row | {"seconds": round(time.monotonic() - began)}


def run_together(mutations: Sequence[Mutation], folder: Path, tests: Sequence[str], limit: float) -> None:
    """Runs tests with all changes at once, then those that fail with each change alone, and writes the table."""
    with planted(mutations, folder):
        ended = pytest(tests, folder, limit)
    failures = failed(ended.stdout)
    print(f"{len(failures)} tests fail with {len(mutations)} changes\n{ended.stdout[-300:]}", flush=True)
    if not failures:
        return
    failures = [test for test in failures if test not in failed(pytest(failures, folder, limit).stdout)]
    for mutation in mutations:
        began = time.monotonic()
        with planted([mutation], folder):
            caught = failed(pytest(failures, folder, limit, "-x").stdout)
        outcome = {"caught_by": caught[0].partition("[")[0] if caught else None, "stage": 2 if caught else None}
        print(f"{mutation.file}  {mutation.kind}: {outcome['caught_by'] or 'MISSED'}", flush=True)
        write({key(mutation): as_row(mutation) | outcome | {"seconds": round(time.monotonic() - began)}})


def main() -> None:
    """Runs the mutations and writes the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="text in the file or in the changed line")
    parser.add_argument("--again", action="store_true", help="also those that the table has")
    parser.add_argument("--missed", action="store_true", help="those that the table has as missed")
    parser.add_argument(
        "--stages", type=int, default=2, choices=(1, 2), help="1: only the tests of the changed file; 2: then all"
    )
    parser.add_argument("--part", default="0/1", help="i/n: every n-th mutation, from the i-th")
    parser.add_argument("--limit", type=float, default=LIMIT, help="seconds for the tests of one stage")
    parser.add_argument("--together", nargs="*", metavar="TESTS", help="those missed, at once, by these tests or all")
    parser.add_argument("--check", action="store_true", help="only check that every line is there")
    arguments = parser.parse_args()
    check()
    if arguments.check:
        return
    i, n = map(int, arguments.part.split("/"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "copy"
        folder.mkdir()
        copied(folder)
        if arguments.together is not None:
            recorded = table()
            missed = [m for m in MUTATIONS if key(m) in recorded and recorded[key(m)]["caught_by"] is None]
            run_together(
                [m for m in missed if arguments.only in m.file + m.old],
                folder,
                arguments.together or ["tests"],
                arguments.limit,
            )
            return
        for mutation in MUTATIONS[i::n]:
            old = table().get(key(mutation))
            again = arguments.again or (arguments.missed and old is not None and old["caught_by"] is None)
            if arguments.only not in mutation.file + mutation.old or (old is not None and not again):
                continue
            row = run(mutation, folder, arguments.stages, arguments.limit)
            print(
                f"{row['seconds']:>5} s  {mutation.file}  {mutation.kind}: {row['caught_by'] or 'MISSED'}", flush=True
            )
            write({key(mutation): row})
    write({})
    rows = table().values()
    missed = [row for row in rows if row["caught_by"] is None]
    print(f"{len(rows) - len(missed)} of {len(rows)} caught, {len(MUTATIONS)} in all")


def key(mutation: Mutation) -> tuple[str, str, str]:
    return mutation.file, mutation.old, mutation.new


def table() -> dict[tuple[str, str, str], dict]:
    """Returns the rows of the table whose mutations are still made."""
    if not RESULTS.exists():
        return {}
    planted_keys = {key(mutation) for mutation in MUTATIONS}
    rows = json.loads(RESULTS.read_text(encoding="utf-8"))["mutations"]
    return {k: row for row in rows if (k := (row["file"], row["old"], row["new"])) in planted_keys}


def write(new: dict[tuple[str, str, str], dict]) -> None:
    """Adds rows to the table, in the order of :data:`MUTATIONS`."""
    rows = table() | new
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    ordered = [rows[key(m)] for m in MUTATIONS if key(m) in rows]
    caught = sum(row["caught_by"] is not None for row in ordered)
    at_first, elsewhere = (
        [
            mutation.at_first
            for mutation in MUTATIONS
            if mutation.at_first and (mutation.room is not None) == is_elsewhere
        ]
        for is_elsewhere in (False, True)
    )
    content = {
        "command": "python trials/mutations.py",
        "commit": commit.stdout.strip(),
        "date": time.strftime("%Y-%m-%d"),
        "summary": {
            "planted": len(MUTATIONS),
            "tried": len(ordered),
            "caught": caught,
            "planted by someone who knew neither the list nor the tests": len(at_first),
            "of these caught at first": at_first.count("caught"),
            "planted outside of algorithms, buffers and loops by someone who had not read the tests": len(elsewhere),
            "of these caught at first, outside": elsewhere.count("caught"),
        },
        "rooms": [
            {"room": room, "planted": len(first), "caught_at_first": first.count("caught")}
            for room in sorted({mutation.room for mutation in MUTATIONS if mutation.room is not None})
            if (first := [mutation.at_first for mutation in MUTATIONS if mutation.room == room])
        ],
        "mutations": ordered,
    }
    RESULTS.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
