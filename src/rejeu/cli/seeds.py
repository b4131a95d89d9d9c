"""``rejeu train ENV --seeds N``: several seeds in processes of their own, and the comparison of them."""

from __future__ import annotations

import dataclasses
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rejeu import xla
from rejeu.cli import jsonout
from rejeu.cli.commands import Train
from rejeu.cli.output import echo
from rejeu.cli.run_folder import check_free
from rejeu.cli.status import best_text, describe, steps_text
from rejeu.errors import MissingExtra
from rejeu.interrupt import NAMES, Interrupt
from rejeu.reporting.comparison import Comparison, compare
from rejeu.reporting.runs import read_run
from rejeu.reporting.tabular import interval_text

if TYPE_CHECKING:
    from rich.table import Table

OPTIONS = {"imports": "--import", "assignments": "--set"}
"""Options whose name differs from that of the argument."""
OWN = {"env", "seeds", "jobs", "seed", "out", "json"}
"""Arguments that are not passed on to the processes as they are."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
POLL = 0.5
"""Seconds between two looks at the processes."""


class Job:
    """The run of one seed in a process. Mutable."""

    def __init__(self, seed: int, folder: Path) -> None:
        self.seed, self.path, self.log = seed, folder / f"seed_{seed}", folder / f"seed_{seed}.log"
        self.process: subprocess.Popen[bytes] | None = None
        self.status: int | None = None
        """Exit status; None before the end."""

    def start(self, arguments: Train, environ: dict[str, str]) -> None:
        """Starts the process; what it prints goes to the log."""
        words = [sys.executable, "-m", "rejeu", "train", arguments.env, *options(arguments)]
        words += ["--seed", str(self.seed), "--out", str(self.path)]
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environ,
                # Ctrl-C reaches it once, through stop; on Windows the console sends it to all processes
                process_group=0 if os.name == "posix" else None,
            )

    def stop(self) -> None:
        """Asks the process to stop after the current step, with a checkpoint."""
        if self.process is not None and self.process.poll() is None and os.name == "posix":
            self.process.send_signal(signal.SIGINT)

    def has_ended(self) -> bool:
        """Returns whether the process has ended, and keeps its exit status."""
        if self.process is not None and self.status is None:
            self.status = self.process.poll()
        return self.status is not None

    def last_line(self) -> str:
        """Returns the last line of the log."""
        with self.log.open("rb") as file:
            file.seek(max(self.log.stat().st_size - 4096, 0))
            lines = file.read().decode("utf-8", "replace").split("\n")
        return next((line.strip() for line in reversed(lines) if line.strip()), "it printed nothing")


def run(arguments: Train) -> int:
    """Trains all seeds and compares them; returns 0, 2 if a seed failed, 130 after Ctrl-C and 143 after SIGTERM."""
    return jsonout.run(train_all, arguments)


def train_all(arguments: Train) -> tuple[int, dict[str, Any]]:
    """Trains all seeds and compares them; returns the exit status and the result."""
    assert arguments.seeds is not None
    folder = make_folder(arguments)
    first = int(np.random.default_rng().integers(10_000)) if arguments.seed is None else arguments.seed
    jobs = [Job(first + i, folder) for i in range(arguments.seeds)]
    at_once = min(arguments.jobs or max(xla.cores() // 2, 1), len(jobs))
    echo(f"run folders   {folder}, {len(jobs)} seeds from {first}, {at_once} at once")
    with Interrupt() as stop:
        train(jobs, arguments, at_once, stop)
    failed = [job for job in jobs if job.status not in (0, None) and not (stop.requested and job.status > 128)]
    for job in failed:
        echo(f"seed {job.seed} failed with exit status {job.status}: {job.last_line()} (log {job.log})")
    comparison = summarize(folder)
    runs = [{"seed": job.seed, "path": job.path, "log": job.log, "exit_status": job.status} for job in jobs]
    result = {"folder": folder, "runs": runs, "comparison": None if comparison is None else comparison.table()}
    if stop.signal is not None:
        begun = [job for job in jobs if job.process is not None]
        echo(f"stopped by {NAMES[stop.signal]}; rejeu resume {begun[0].path if begun else folder} continues a seed")
        return 128 + stop.signal, result
    return (2 if failed else 0), result


def make_folder(arguments: Train) -> Path:
    """Returns a new folder for the run folders: ``--out``, or one under ``runs``."""
    check_free(arguments.out)
    name = "-".join(filter(None, [arguments.env, arguments.algo, "seeds", time.strftime("%Y%m%d-%H%M%S")]))
    folder = arguments.out or Path("runs") / re.sub(r"[^\w.-]+", "-", name)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def environment(at_once: int) -> dict[str, str]:
    """Returns the environment variables of a process: its share of the cores, so that the runs do not slow each other."""
    share = max(xla.cores() // at_once, 1)
    found = {**os.environ, **{name: os.environ.get(name, str(share)) for name in THREADS}}
    if share == 1:
        found.setdefault(xla.THREADS, "1")
    return found


def options(arguments: Train) -> list[str]:
    """Returns the command line of a single run: every option that was given.

    >>> options(Train("CartPole-v1", steps=10, seeds=5, assignments=(("gamma=0.9",), ("tau=1",))))
    ['--steps', '10', '--set', 'gamma=0.9', '--set', 'tau=1']
    """
    words: list[str] = []
    for field in dataclasses.fields(arguments):
        value: Any = getattr(arguments, field.name)
        if field.name in OWN or value == field.default:
            continue
        option = OPTIONS.get(field.name, f"--{field.name.replace('_', '-')}")
        if value is True:
            words.append(option)
        elif isinstance(value, tuple):
            for one in value:
                words += [option, *([one] if isinstance(one, str) else one)]
        else:
            words += [option, str(value)]
    return words


def train(jobs: list[Job], arguments: Train, at_once: int, stop: Interrupt) -> None:
    """Runs the processes, ``at_once`` at a time, until all have ended; shows a live table on a terminal."""
    from rich.console import Console
    from rich.live import Live

    environ = environment(at_once)
    waiting, was_stopped = list(jobs), False
    console = Console()
    with Live(console=console, auto_refresh=False, transient=False) as live:
        while True:
            for job in jobs:
                if job.status is None and job.has_ended() and not console.is_terminal:
                    echo(
                        f"seed {job.seed}: exit status {job.status}, {best_text(describe(read_run(job.path))['best'])}"
                        if job.path.is_dir()
                        else f"seed {job.seed}: exit status {job.status}"
                    )
            running = [job for job in jobs if job.process is not None and job.status is None]
            if stop.requested and not was_stopped:
                was_stopped, waiting = True, []
                for job in running:
                    job.stop()
            while waiting and len(running) < at_once:
                running.append(waiting.pop(0))
                running[-1].start(arguments, environ)
            if console.is_terminal:
                live.update(table(jobs), refresh=True)
            if not running and not waiting:
                return
            time.sleep(POLL)


def table(jobs: Iterable[Job]) -> Table:
    """Returns the state of all seeds as a table."""
    from rich import box
    from rich.table import Table

    found = Table(box=box.SIMPLE)
    for name in ("seed", "state", "steps", "training return", "best evaluation"):
        found.add_column(name, justify="left" if name == "state" else "right")
    for job in jobs:
        cells = ["-"] * 3
        if job.path.is_dir():
            try:
                facts = describe(read_run(job.path))
                value = facts["mean_return"]
                cells = [steps_text(facts), "-" if value != value else f"{value:,.2f}", best_text(facts["best"])]
            except OSError:
                pass
        state = (
            "waiting"
            if job.process is None
            else "running"
            if job.status is None
            else "done"
            if job.status == 0
            else "failed"
        )
        state = "stopped" if job.status in (130, 143) else state
        found.add_row(str(job.seed), state, *cells)
    return found


def summarize(folder: Path) -> Comparison | None:
    """Writes ``compare.html`` and prints the score with its interval, or why there is none; returns the comparison."""
    try:
        comparison = compare(folder)
    except (ValueError, FileNotFoundError) as error:
        echo(f"no comparison: {error}")
        return None
    for group in comparison.groups:
        echo(f"{group.label} on {group.env_id}: {interval_text(group)}")
    echo(comparison.definition)
    for note in comparison.notes:
        echo(f"note: {note}")
    try:
        echo(f"comparison    {comparison.save(folder / 'compare.html')[0]}")
    except (MissingExtra, OSError) as error:
        echo(f"no compare.html: {error}; rejeu compare {folder} --out compare.md writes the tables")
    return comparison
