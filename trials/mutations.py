"""Planted bugs: single lines of the package are changed, and the default tests must notice each of them.

Run it with the active python::

    python trials/mutations.py                      # all that are not in the table yet
    python trials/mutations.py --only td3 --again   # those whose file or name contains the text, also known ones
    python trials/mutations.py --check              # only whether every line that is changed is still there

Each mutation is made in a copy of the tracked files, and the default tests run there with ``pytest -x``: first the files
that are about what was changed, then the folders around it. The first test that fails is written beside the bug to
``trials/results/mutations.json``, from which the page "How we check" has its table. A mutation that no test notices is
*missed*. The lines are in ``trials/mutations.toml``. One that no longer
occurs exactly once stops the script before anything runs.
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
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
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
    at_first: str | None = None
    """``caught`` or ``missed``: what the tests did at first, of a bug by someone who knew neither the list nor the tests."""


MUTATIONS = [
    Mutation(**one)
    for one in tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))["mutation"]
]
"""The lines and what takes their place."""

STAGES = {
    "algorithms/sac/": ["tests/algorithms/test_off_policy_updates.py"],
    "algorithms/ddpg/": ["tests/algorithms/test_off_policy_updates.py"],
    "algorithms/td3": ["tests/algorithms/test_off_policy_updates.py"],
    "algorithms/tqc": ["tests/algorithms/test_tqc.py", "tests/algorithms/test_off_policy_updates.py"],
    "algorithms/quantile": ["tests/algorithms/test_tqc.py"],
    "algorithms/actor_critic/gae": ["tests/algorithms/test_gae.py"],
    "algorithms/actor_critic/": ["tests/buffers/test_rollout.py", "tests/algorithms/test_ppo.py"],
    "algorithms/dqn": ["tests/algorithms/test_dqn.py", "tests/algorithms/test_recorded_updates.py"],
    "algorithms/": ["tests/algorithms/test_NAME.py"],
    "buffers/ring": ["tests/buffers/test_uniform.py"],
    "buffers/uniform": ["tests/buffers/test_uniform.py", "tests/test_offline.py"],
    "buffers/": ["tests/buffers/test_NAME.py"],
    "loops/device/": ["tests/loops/device", "tests/test_schedules.py"],
    "loops/on_policy": ["tests/test_normalization.py", "tests/test_schedules.py"],
    "loops/": ["tests/test_schedules.py", "tests/agents/test_agent.py"],
    "agents/": ["tests/test_schedules.py", "tests/agents/test_agent.py"],
    "core": ["tests/algorithms/test_off_policy_updates.py"],
    "exploration/": ["tests/exploration", "tests/algorithms/test_keys.py"],
    "networks/memory": ["tests/algorithms/test_memory.py"],
    "networks/": ["tests/networks/test_NAME.py"],
    "envs/functional/": ["tests/envs/functional/test_NAME.py"],
    "callbacks/": ["tests/callbacks"],
    "sb3/": ["tests/sb3/test_vec_env.py"],
    "": ["tests/test_NAME.py"],
}
"""By the first characters of the file: the tests that are about it. NAME stands for the file's own."""
KINDS = {
    "sac/continuous": "SAC",
    "sac/discrete": "SAC",
    "ddpg/continuous": "DDPG",
    "quantile_loss": "TQC",
    "actor_critic/steps": "PPO or A2C",
    "actor_critic/gae": "PPO or A2C",
}
"""By the file in ``algorithms/``, the algorithms whose settings are tried; elsewhere the file has their name."""
WIDER = {
    "algorithms/": ["tests/algorithms/test_every_setting.py", "-k", "KIND"],
    "core": ["tests/algorithms/test_every_setting.py"],
    "distributions": ["tests/algorithms"],
    "buffers/": ["tests/buffers"],
}
WIDEST = [
    "tests/algorithms",
    "tests/buffers",
    "tests/loops",
    "tests/agents",
    "tests/exploration",
    "tests/test_schedules.py",
]


def stages(mutation: Mutation) -> list[list[str]]:
    """Returns the tests to run one after the other."""
    name = Path(mutation.file).stem
    first = next(tests for prefix, tests in STAGES.items() if mutation.file.startswith(prefix))
    first = [test.replace("NAME", name) for test in first]
    wider = [tests for prefix, tests in WIDER.items() if mutation.file.startswith(prefix)]
    of_algorithm = mutation.file.removeprefix("algorithms/").removesuffix(".py")
    kind = KINDS.get(of_algorithm, name)
    wider = [[kind if test == "KIND" else test for test in tests] for tests in wider]
    return [[test for test in first if (ROOT / test).exists()], *wider, WIDEST]


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


def run(mutation: Mutation, folder: Path, n_stages: int) -> dict[str, object]:
    """Makes the change in ``folder``, runs the tests, takes it back, and returns a row of the table."""
    path = folder / "src/rejeu" / mutation.file
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(mutation.old, mutation.new), encoding="utf-8")
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(folder / "src"), str(folder)]),
        "JAX_PLATFORMS": "cpu",
    }
    row: dict[str, object] = {name: value for name, value in mutation._asdict().items() if value}
    row |= {"caught_by": None, "stage": None}
    began, done = time.monotonic(), list[str]()
    try:
        for number, tests in enumerate(stages(mutation)[:n_stages], 1):
            tests = [test for test in tests if test not in done]
            done += [] if "-k" in tests else tests
            if not tests:
                continue
            command = [sys.executable, "-m", "pytest", "-x", "-q", "--no-header", "-p", "no:cacheprovider", *tests]
            try:
                ended = subprocess.run(
                    command, cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT
                )
            except subprocess.TimeoutExpired:
                row |= {"caught_by": f"no end after {LIMIT} s", "stage": number}
                break
            if ended.returncode == 1:
                found = re.search(r"^(?:FAILED|ERROR) (\S+?)(?:\[.*)?(?: - .*)?$", ended.stdout, re.MULTILINE)
                row |= {"caught_by": found[1] if found else "?", "stage": number}
                break
            if ended.returncode not in (0, 5):  # 5: there is no such test
                sys.exit(
                    f"pytest ended with {ended.returncode} on {mutation}:\n{ended.stdout[-2000:]}{ended.stderr[-2000:]}"
                )
    finally:
        path.write_text(text, encoding="utf-8")
    return row | {"seconds": round(time.monotonic() - began)}


def main() -> None:
    """Runs the mutations and writes the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="text in the file or in the changed line")
    parser.add_argument("--again", action="store_true", help="also those that the table has")
    parser.add_argument("--missed", action="store_true", help="those that the table has as missed")
    parser.add_argument("--stages", type=int, default=3, help="how far around what was changed tests are run, 1 to 3")
    parser.add_argument("--part", default="0/1", help="i/n: every n-th mutation, from the i-th")
    parser.add_argument("--check", action="store_true", help="only check that every line is there")
    given = parser.parse_args()
    check()
    if given.check:
        return
    i, n = map(int, given.part.split("/"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "copy"
        folder.mkdir()
        copied(folder)
        for mutation in MUTATIONS[i::n]:
            old = table().get(key(mutation))
            again = given.again or (given.missed and old is not None and old["caught_by"] is None)
            if given.only not in mutation.file + mutation.old or (old is not None and not again):
                continue
            row = run(mutation, folder, given.stages)
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
    known = {key(mutation) for mutation in MUTATIONS}
    rows = json.loads(RESULTS.read_text(encoding="utf-8"))["mutations"]
    return {k: row for row in rows if (k := (row["file"], row["old"], row["new"])) in known}


def write(new: dict[tuple[str, str, str], dict]) -> None:
    """Adds rows to the table, in the order of :data:`MUTATIONS`."""
    rows = table() | new
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    ordered = [rows[key(m)] for m in MUTATIONS if key(m) in rows]
    caught = sum(row["caught_by"] is not None for row in ordered)
    at_first = [mutation.at_first for mutation in MUTATIONS if mutation.at_first]
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
        },
        "mutations": ordered,
    }
    RESULTS.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
