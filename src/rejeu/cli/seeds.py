"""``rejeu train ENV --seeds N``: several seeds in processes of their own, and the comparison of them."""

from __future__ import annotations

import dataclasses
import os
import re
import time
from pathlib import Path
from typing import Any

import numpy as np

from rejeu.cli import jsonout, sweep
from rejeu.cli.commands import Train
from rejeu.experiments.folder import Sweep, open_folder
from rejeu.experiments.jobs import Job
from rejeu.experiments.process import LocalLauncher, default_workers, threads_of
from rejeu.experiments.table import echo
from rejeu.runs.config import RunConfig
from rejeu.runs.folder import check_free


def run(arguments: Train) -> int:
    """Trains all seeds and compares them; returns 0, 2 if a seed failed, 130 after Ctrl-C and 143 after SIGTERM."""
    return jsonout.run(train_all, arguments)


def train_all(arguments: Train) -> tuple[int, dict[str, Any]]:
    """Trains all seeds and compares them; returns the exit status and the result."""
    jobs = make_jobs(arguments)
    at_once = min(arguments.jobs or default_workers(), len(jobs))
    path = choose_folder(arguments)
    folder = open_folder(path, Sweep(jobs=jobs, threads=threads_of(at_once)), None, arguments)
    echo(f"run folders   {path}, {len(jobs)} seeds from {jobs[0].run.seed}, {at_once} at once")
    launcher = LocalLauncher(at_once, folder.sweep.threads)
    status, outcomes, comparison = sweep.train(folder, launcher, arguments, replaces=("seed_", "seed "))
    keys = ("path", "log", "exit_status", "state")
    runs = [{"seed": one.job.run.seed, **{key: getattr(one, key) for key in keys}} for one in outcomes]
    return status, {"folder": path, "runs": runs, "comparison": comparison}


def make_jobs(arguments: Train) -> tuple[Job, ...]:
    """Returns one job for each seed.

    Raises:
        ValueError: for an invalid option.
    """
    assert arguments.seeds is not None
    if arguments.pause is not None:
        raise ValueError("--pause is for a single run; leave out --seeds, or --pause")
    first = int(np.random.default_rng().integers(10_000)) if arguments.seed is None else arguments.seed
    given = {one.name: getattr(arguments, one.name) for one in dataclasses.fields(RunConfig)}
    if arguments.ray not in (None, "auto"):
        os.environ["RAY_ADDRESS"] = arguments.ray  # no file may name an address
    run = RunConfig(**{**given, "ray": None if arguments.ray is None else "auto", "imports": ()})
    return tuple(
        Job(
            name=f"seed_{seed}",
            run=dataclasses.replace(run, seed=seed),
            no_report=arguments.no_report,
            no_video=arguments.no_video,
        )
        for seed in range(first, first + arguments.seeds)
    )


def choose_folder(arguments: Train) -> Path:
    """Returns a new or empty folder for the run folders: ``--out``, or one under ``runs``."""
    check_free(arguments.out)
    name = "-".join(filter(None, [arguments.env, arguments.algorithm, "seeds", time.strftime("%Y%m%d-%H%M%S")]))
    return arguments.out or Path("runs") / re.sub(r"[^\w.-]+", "-", name)
