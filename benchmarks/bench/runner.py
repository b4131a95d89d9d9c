"""Runs the measurements one after the other, each in a new process, and saves every sample immediately."""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.bench import machine
from benchmarks.bench.plan import VARIANTS, Measurement
from benchmarks.bench.summary import cost

ROOT = Path(__file__).resolve().parents[2]
TIMEOUT = 900.0
"""Timeout of a measurement, in seconds."""

Sample = dict[str, Any]


class Samples:
    """The samples file: a header and one line of JSON per sample. Each line is written as soon as it is available."""

    def __init__(self, path: Path, header: Mapping[str, Any], resume: bool) -> None:
        """Creates a file, or opens an existing one to continue it.

        Raises:
            SystemExit: if the existing file belongs to a run with other settings.
        """
        self.path, self.header = path, dict(header)
        self.samples: list[Sample] = []
        if resume and path.exists():
            lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
            recorded = json.loads(lines[0])
            for name in ("settings", "versions"):
                if recorded[name] != self.header[name]:
                    raise SystemExit(
                        f"{path} is of a run with other {name}: {recorded[name]}, now {self.header[name]}; "
                        "run without --resume"
                    )
            self.header = recorded
            self.samples = [json.loads(line) for line in lines[1:]]
            self.samples = [sample for sample in self.samples if "error" not in sample]
        path.parent.mkdir(parents=True, exist_ok=True)
        rows = [self.header, *self.samples]
        path.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")

    def add(self, sample: Sample) -> None:
        """Appends a sample."""
        self.samples.append(sample)
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(sample) + "\n")

    def has(self, key: str, variant: str, turn: int) -> bool:
        """Returns whether a sample exists."""
        return any((s["key"], s["variant"], s["round"]) == (key, variant, turn) for s in self.samples)


def variants_of(measurement: Measurement, turn: int, samples: Sequence[Sample]) -> tuple[str, ...]:
    """Returns the variants to measure in a round: all in the first round, then only the fastest one."""
    if turn == 0 or len(measurement.variants) == 1:
        return measurement.variants
    first = [s for s in samples if s["key"] == measurement.key and s["round"] == 0 and "error" not in s]
    return (min(first, key=cost)["variant"],) if first else measurement.variants


def run_all(
    plan: Sequence[Measurement], rounds: int, pythons: Mapping[str, str], samples: Samples, cache: Path
) -> None:
    """Runs all measurements ``rounds`` times, except those whose samples exist."""
    began = time.perf_counter()
    before = machine.calibrate()
    for turn in range(rounds):
        for measurement in plan:
            if measurement.rounds is not None and turn >= measurement.rounds:
                continue
            for variant in variants_of(measurement, turn, samples.samples):
                if samples.has(measurement.key, variant, turn):
                    continue
                busy = machine.others_busy()
                sample = {
                    "key": measurement.key,
                    "case": measurement.case,
                    "name": measurement.name,
                    "library": measurement.library,
                    "variant": variant,
                    "round": turn,
                    "others_busy": busy,
                    **measure(measurement, turn, pythons[measurement.library], variant, cache),
                }
                after = machine.calibrate()
                sample["calibration_ms"] = [before, after]
                before = after
                samples.add(sample)
                print(line(sample, turn, rounds, time.perf_counter() - began), flush=True)


def line(sample: Sample, turn: int, rounds: int, elapsed: float) -> str:
    """Returns a one-line description of a sample."""
    label = f"{sample['key']}{', ' + sample['variant'] if sample['variant'] else ''}"
    told = "FAILED: " + sample["error"].splitlines()[-1][:120] if "error" in sample else f"{cost(sample):.4g} s"
    if sample["case"] in ("steps", "rollouts") and "error" not in sample:
        told = f"{1e6 * cost(sample):,.0f} us a step"
    busy = sample["others_busy"]
    warning = f"   BUSY: others use {busy} cores" if busy is not None and busy > machine.BUSY else ""
    clock = f"{int(elapsed) // 60:3d}:{int(elapsed) % 60:02d}"
    return f"{clock}  round {turn + 1}/{rounds}  {label:<60} {told:<22} took {sample['wall_seconds']:.1f} s{warning}"


def measure(measurement: Measurement, turn: int, python: str, variant: str, cache: Path) -> Sample:
    """Runs one measurement in its own process and returns its result, or the error that ended it."""
    arguments = dict(measurement.arguments)
    if measurement.counts and turn == 0:
        arguments["count"] = True
    command = [python, "-m", f"benchmarks.bench.work.{measurement.worker}", json.dumps(arguments)]
    environment = child_environment(measurement, variant, cache)
    began = time.perf_counter()
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, cwd=ROOT
    )
    try:
        output, errors = process.communicate(timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        output, errors = "", f"it took longer than {TIMEOUT:.0f} s"
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
    seconds = time.perf_counter() - began
    if process.returncode:
        return {"wall_seconds": seconds, "error": errors.strip()[-2000:] or f"exit status {process.returncode}"}
    return {"wall_seconds": seconds, "result": json.loads(output.strip().splitlines()[-1])}


def child_environment(measurement: Measurement, variant: str, cache: Path) -> dict[str, str]:
    """Returns the environment variables for the process of a measurement."""
    environment = {**os.environ, **VARIANTS[variant], "PYTHONWARNINGS": "ignore", "JAX_PLATFORMS": "cpu"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # pip compiles packages, the first import a checkout
    if measurement.library == "rejeu":
        source = str(ROOT / "src")
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, (source, os.environ.get("PYTHONPATH", ""))))
    else:
        environment.pop("PYTHONPATH", None)
    folder = cache / measurement.library
    environment["JAX_COMPILATION_CACHE_DIR"] = str(folder) if measurement.keeps_compiled else ""
    environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    return environment
