"""Measures rejeu, other libraries and the machine's limits in one run, and writes a page with the results.

    scripts/bench                                        # creates the other libraries' environments; 35 minutes
    scripts/bench --sb3-python PATH --sbx-python PATH    # uses existing environments
    scripts/bench --resume                               # continues an interrupted run
    scripts/bench --report                               # rewrites the page from existing samples

Every measurement runs in a new process. The libraries alternate, in several rounds. Each sample is appended to
``benchmarks/results/bench.jsonl`` as soon as it is measured. At the end, all samples and a description of the machine
are written to ``benchmarks/results/bench.json``. ``benchmarks/performance.md`` is generated from that file.

Other programs distort the timings, so the command refuses to run on a busy machine.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import platformdirs

from benchmarks.bench import machine, peers, plan, report, runner

RESULT = runner.ROOT / "benchmarks" / "results" / "bench.json"
PAGE = runner.ROOT / "benchmarks" / "performance.md"
TAKES_PATHS = ("--sb3-python", "--sbx-python", "--peers", "--out", "--page")


def parser() -> argparse.ArgumentParser:
    """Returns the parser of the command line."""
    parser = argparse.ArgumentParser(
        "scripts/bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--cases", nargs="+", choices=plan.CASES, default=list(plan.CASES), help="what to measure; default: everything")
    add("--libraries", nargs="+", choices=plan.LIBRARIES, default=list(plan.LIBRARIES), help="whom; default: all")
    add("--rounds", type=int, default=3, help="turns of every measurement")
    add("--quick", action="store_true", help="one tiny round, to see that everything runs; its figures mean nothing")
    add("--resume", action="store_true", help="go on with the samples that are there")
    add("--report", action="store_true", help="measure nothing: write the page from the file of results")
    add("--busy", action="store_true", help="measure although the machine is busy")
    add(
        "--sb3-python",
        metavar="PATH",
        help="interpreter with stable-baselines3, sb3-contrib, highway-env, gymnasium[box2d]",
    )
    add("--sbx-python", metavar="PATH", help="interpreter with sbx-rl, stable-baselines3 and gymnasium[box2d]")
    add(
        "--peers", type=Path, metavar="DIR", help="where environments for the peers are made; default: the cache folder"
    )
    add("--out", type=Path, default=RESULT, help="the file of results")
    add("--page", type=Path, default=PAGE, help="the page")
    return parser


def shown_command(arguments: Sequence[str]) -> str:
    """Returns the command without paths of this machine.

    >>> shown_command(["--rounds", "2", "--sb3-python", "envs/sb3/python"])
    'scripts/bench --rounds 2 --sb3-python PATH'
    """
    words, hide = [], False
    for word in arguments:
        name, equals, _ = word.partition("=")
        words.append("PATH" if hide else f"{name}=PATH" if equals and name in TAKES_PATHS else word)
        hide = word in TAKES_PATHS
    return shlex.join(["scripts/bench", *(word for word in words if word not in ("--resume", "--busy"))])


def interpreters(arguments: argparse.Namespace) -> dict[str, str]:
    """Returns the Python interpreter of each library, and creates the environments that are not given.

    Raises:
        SystemExit: if an environment lacks a required module.
    """
    root = arguments.peers or Path(platformdirs.user_cache_dir("rejeu", appauthor=False)) / "bench-peers"
    pythons = {"rejeu": sys.executable}
    for library in ("sb3", "sbx"):
        if library in arguments.libraries:
            pythons[library] = getattr(arguments, f"{library}_python") or peers.make(library, root)
    for library in arguments.libraries:
        lacking = peers.missing(pythons[library], library)
        if lacking:
            raise SystemExit(f"{pythons[library]} lacks {', '.join(lacking)}, which the measurements of {library} need")
    return pythons


def header_of(arguments: argparse.Namespace, pythons: dict[str, str], command: str) -> dict[str, Any]:
    """Returns the metadata of the run for the results file."""
    settings = {"rounds": arguments.rounds, "quick": arguments.quick, "cases": arguments.cases}
    settings["libraries"] = arguments.libraries
    return {
        "command": command,
        "settings": settings,
        "machine": machine.describe() | {"load_before": machine.load()},
        "versions": {library: machine.versions(pythons[library], library) for library in arguments.libraries},
        "variants": plan.VARIANTS,
    }


def write_results(path: Path, samples: runner.Samples) -> dict[str, Any]:
    """Writes all samples and the metadata to the results file, one sample per line, and returns them."""
    head = json.dumps(samples.header, indent=1)[:-2]
    rows = ",\n".join("  " + json.dumps(sample) for sample in samples.samples)
    path.write_text(f'{head},\n "samples": [\n{rows}\n ]\n}}\n', encoding="utf-8")
    return {**samples.header, "samples": samples.samples}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command and returns its exit status."""
    argv = sys.argv[1:] if argv is None else argv
    arguments = parser().parse_args(argv)
    if arguments.report:
        report.write(json.loads(arguments.out.read_text(encoding="utf-8")), arguments.page)
        return 0
    if arguments.quick:
        arguments.rounds = 1
    if arguments.quick and arguments.out == RESULT:
        arguments.out, arguments.page = [Path(tempfile.gettempdir()) / name for name in ("bench.json", "bench.md")]
    reason = machine.why_busy()
    if reason is not None:
        print(f"THIS MACHINE IS BUSY: {reason}. Timings taken now are worthless.", file=sys.stderr)
        if not (arguments.quick or arguments.busy):
            print("Wait until it is quiet, or give --busy to measure nonetheless.", file=sys.stderr)
            return 2
    elif (machine.load() or 0.0) > machine.BUSY:
        print(f"WARNING: the load average is {machine.load()}: something ran until just now.", file=sys.stderr)
    pythons = interpreters(arguments)
    measurements = [
        m for m in plan.everything(arguments.quick) if m.case in arguments.cases and m.library in arguments.libraries
    ]
    sample_file = arguments.out.with_suffix(".jsonl")
    samples = runner.Samples(sample_file, header_of(arguments, pythons, shown_command(argv)), arguments.resume)
    try:
        with tempfile.TemporaryDirectory() as cache:
            runner.run_all(measurements, arguments.rounds, pythons, samples, Path(cache))
    except KeyboardInterrupt:
        print(f"\nstopped; what was measured is in {sample_file}, and --resume goes on", file=sys.stderr)
        return 130
    report.write(write_results(arguments.out, samples), arguments.page)
    failed = [sample["key"] for sample in samples.samples if "error" in sample]
    print(f"samples: {arguments.out}\npage: {arguments.page}")
    if failed:
        print(f"FAILED: {', '.join(failed)}; see the samples, and run again with --resume", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
