"""``rejeu train ENV --seeds N``: several seeds in processes of their own, and the comparison of them."""

from __future__ import annotations

import dataclasses
import os
import re
import time
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from rejeu.cli import jsonout, settings, sweep
from rejeu.cli.commands import Train
from rejeu.cli.run_folder import check_free
from rejeu.interrupt import NAMES, Interrupt
from rejeu.reporting.text import quoted
from rejeu.sweeps.coordinator import Coordinator
from rejeu.sweeps.folder import Sweep, open_folder
from rejeu.sweeps.jobs import Code, Job, Options, again
from rejeu.sweeps.processes import LocalLauncher, default_workers, threads_of
from rejeu.sweeps.table import echo, shown

OWN = {
    "env",
    "seeds",
    "jobs",
    "seed",
    "out",
    "json",
    "algo",
    "assignments",
    "env_kwargs",
    "wrapper",
    "imports",
    "pause",
}
"""Arguments that are no options of a job."""


def run(arguments: Train) -> int:
    """Trains all seeds and compares them; returns 0, 2 if a seed failed, 130 after Ctrl-C and 143 after SIGTERM."""
    return jsonout.run(train_all, arguments)


def train_all(arguments: Train) -> tuple[int, dict[str, Any]]:
    """Trains all seeds and compares them; returns the exit status and the result."""
    jobs = make_jobs(arguments)
    at_once = min(arguments.jobs or default_workers(), len(jobs))
    code = Code(env=arguments.env, wrappers=arguments.wrapper, imports=arguments.imports)
    path = choose_folder(arguments)
    folder = open_folder(path, Sweep(jobs=jobs, threads=threads_of(at_once)), None, code)
    echo(f"run folders   {path}, {len(jobs)} seeds from {jobs[0].seed}, {at_once} at once")
    with Interrupt() as stop, shown(folder) as (watch, say):
        launcher = LocalLauncher(at_once, folder.sweep.threads)
        coordinator = Coordinator(folder, launcher, stop, code, say=lambda text: say(text.replace("seed_", "seed ", 1)))
        coordinator.run(watch)
    comparison = sweep.summarize(path)
    outcomes = coordinator.outcomes()
    runs = [
        {"seed": one.job.seed, "path": one.path, "log": one.log, "exit_status": one.exit_status, "state": one.state}
        for one in outcomes
    ]
    result = {"folder": path, "runs": runs, "comparison": None if comparison is None else comparison.table()}
    if stop.signal is not None:
        echo(f"stopped by {NAMES[stop.signal]}; rejeu resume {quoted(path)}{again(jobs, code)} continues")
        return 128 + stop.signal, result
    return (2 if any(one.state == "failed" for one in outcomes) else 0), result


def make_jobs(arguments: Train) -> tuple[Job, ...]:
    """Returns one job for each seed.

    Raises:
        ValueError: for an invalid option.
    """
    assert arguments.seeds is not None
    if arguments.pause is not None:
        raise ValueError("--pause is for a single run; leave out --seeds, or --pause")
    first = int(np.random.default_rng().integers(10_000)) if arguments.seed is None else arguments.seed
    given = {one.name: getattr(arguments, one.name) for one in dataclasses.fields(Options)}
    paths = {key: None if given[key] is None else str(given[key]) for key in ("preset", "arrivals")}
    if arguments.ray not in (None, "auto"):
        os.environ["RAY_ADDRESS"] = arguments.ray  # no file may name an address
    ray = None if arguments.ray is None else "auto"
    options = Options(**{**given, **paths, "ray": ray, "log": tuple(chain.from_iterable(arguments.log))})
    words = [*chain.from_iterable(arguments.assignments)]
    settings.apply(words, {})
    return tuple(
        Job(
            name=f"seed_{seed}",
            env=arguments.env,
            seed=seed,
            env_kwargs=settings.apply(chain.from_iterable(arguments.env_kwargs), {}, "--env-kwargs"),
            wrappers=arguments.wrapper,
            algorithm=arguments.algo,
            hyperparameters={
                name.strip(): settings.value(text) for name, _, text in (one.partition("=") for one in words)
            },
            options=options,
        )
        for seed in range(first, first + arguments.seeds)
    )


def choose_folder(arguments: Train) -> Path:
    """Returns a new or empty folder for the run folders: ``--out``, or one under ``runs``."""
    check_free(arguments.out)
    name = "-".join(filter(None, [arguments.env, arguments.algo, "seeds", time.strftime("%Y%m%d-%H%M%S")]))
    return arguments.out or Path("runs") / re.sub(r"[^\w.-]+", "-", name)
