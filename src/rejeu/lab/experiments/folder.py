"""Folders of experiments, each with its plan, and the plan of a sweep.

::

    sweep.json              the plan: the jobs, and what each needs
    plan.toml               copy of the plan as it was given
    compare.html            comparison of the runs

Further files are those of each job; see :mod:`rejeu.lab.experiments.work`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, NamedTuple, TypeVar

from msgspec import Meta

from rejeu.core import atomic
from rejeu.core.errors import CheckpointError
from rejeu.core.records import convert, json_text, read_json, shown
from rejeu.core.validation import assign
from rejeu.lab.experiments.work import HIDDEN, Job, Work
from rejeu.lab.runs.config import RunConfig
from rejeu.logs.formatting import quoted

SWEEP, PLAN = "sweep.json", "plan.toml"
MAX_BYTES = 2**26
"""Upper limit on the size of a ``sweep.json``, and of the journal of a study."""
PATIENCE = 60.0
"""Seconds to wait while another process creates the folder."""

P = TypeVar("P")

MAX_JOBS = 10_000
"""Most runs of a sweep."""
UNITS = {"": 1, "B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}


@dataclass(frozen=True, kw_only=True)
class Resources:
    """Resources of one run on a node of a Ray cluster; Ray starts no more runs on a node than fit."""

    cpus: Annotated[float, Meta(gt=0, le=10_000)] = 1
    """Processor cores."""
    gpus: Annotated[float, Meta(ge=0, le=1000)] = 0
    """GPUs; a fraction shares one."""
    memory: int | str | None = None
    """Memory in bytes, or as ``"4 GB"``; None reserves none."""
    custom: Annotated[dict[str, Annotated[float, Meta(gt=0)]], Meta(max_length=100)] = field(default_factory=dict)
    """Ray's custom resources by name."""

    def __post_init__(self) -> None:
        assign(self, memory=None if self.memory is None else memory_bytes(self.memory))


def memory_bytes(value: object) -> int:
    """Returns an amount of memory in bytes.

    Raises:
        ValueError: if it is none.

    >>> memory_bytes("1.5 GB"), memory_bytes(1000)
    (1500000000, 1000)
    """
    match = re.fullmatch(r"(\d{1,15}(?:\.\d{1,6})?) ?([KMGT]?B)?", str(value))
    if isinstance(value, bool) or match is None or float(match[1]) <= 0:
        raise ValueError(f"memory={value!r} must be a number of bytes, or a text such as '4 GB'")
    return int(float(match[1]) * UNITS[match[2] or ""])


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The jobs of a sweep, and what each needs: what ``sweep.json`` holds."""

    jobs: Annotated[tuple[Job, ...], Meta(min_length=1, max_length=MAX_JOBS)]
    threads: Annotated[int, Meta(ge=1, le=1024)] | None = None
    """Threads of each run, None for its share of the cores. Decided when the sweep begins, since the last bits of results
    depend on it."""
    resources: Resources = field(default_factory=Resources)
    schema: Annotated[int, Meta(ge=1, le=1)] = 1

    def __post_init__(self) -> None:
        if len({job.name.lower() for job in self.jobs}) < len(self.jobs):
            raise ValueError("two jobs have the same name")


class SweepFolder(NamedTuple):
    """The folder of a sweep."""

    path: Path
    plan: Plan

    def works(self, imports: tuple[str, ...] = (), retry: bool = False) -> list[Work]:
        """Returns its jobs as runs that a scheduler trains; ``retry`` tries those again that have failed."""
        return [Work(self.path, job, imports, retry) for job in self.plan.jobs]


def is_sweep(path: Path) -> bool:
    """Returns whether a folder is that of a sweep."""
    return (path / SWEEP).is_file()


def open_folder(path: Path, plan: Plan, text: str | None, typed: RunConfig) -> SweepFolder:
    """Creates the folder of a sweep, or joins one of the same jobs that exists.

    Args:
        path: the folder.
        plan: the jobs; an existing folder's number of threads is kept.
        text: of the plan as it was given, which is copied.
        typed: what the command line named for import.

    Raises:
        FileExistsError, ValueError: as :func:`begin`.
    """
    begin(path, SWEEP, plan, lambda file: read(file, Plan), difference)
    if text is not None and not (path / PLAN).exists():
        atomic.write(path / PLAN, text)
    return read_folder(path, typed)


def difference(old_plan: Plan, plan: Plan) -> str:
    """Returns the difference between the jobs of two plans, as text; empty if they are the same."""
    if old_plan.jobs == plan.jobs:
        return ""
    old, new = ({job.name: job for job in jobs} for jobs in (old_plan.jobs, plan.jobs))
    differing = next((name for name in [*new, *old] if new.get(name) != old.get(name)), "their order")
    return f"the sweep of another plan: {differing} differs"


def read_folder(path: Path, typed: RunConfig) -> SweepFolder:
    """Returns the folder of an existing sweep. Its file is untrusted.

    Raises:
        FileNotFoundError: if it is none.
        CheckpointError: if it is damaged, or names code that the command line does not.
    """
    plan = read(path / SWEEP, Plan)
    for job in plan.jobs:
        job.check_code(typed, path / SWEEP)
    if not os.access(path, os.W_OK):
        raise PermissionError(f"{path} cannot be written; check its permissions")
    atomic.check_no_links(path)
    (path / HIDDEN).mkdir(exist_ok=True)
    return SweepFolder(path, plan)


def begin(path: Path, name: str, plan: P, read: Callable[[Path], P], difference: Callable[[P, P], str]) -> P:
    """Writes the plan of an experiment to a new or empty folder, or joins the one that is there; returns the folder's plan.

    Args:
        path: the folder.
        name: of the file of the plan.
        plan: the plan.
        read: reads such a file.
        difference: returns in what the plan of the folder differs from this one and must not, as text.

    Raises:
        FileExistsError: if the path is a file, or a folder with other things.
        ValueError: if it is the folder of another plan.
    """
    inside = {entry.name for entry in path.iterdir()} if path.is_dir() else {HIDDEN}
    if name not in inside and (inside - {HIDDEN} or path.is_file()):
        raise FileExistsError(
            f"{path} exists and holds something else than {name}; name another folder, or remove it first"
        )
    atomic.check_no_links(path)
    atomic.make_folder(path / HIDDEN)
    with atomic.lock(path / HIDDEN / "lock", timeout=PATIENCE):
        if not (path / name).is_file():
            atomic.write(path / name, json_text(plan))
            return plan
        old_plan = read(path / name)
    if differs := difference(old_plan, plan):
        resume = f"rejeu resume {quoted(path)}"
        raise ValueError(f"{path} is {differs}; name another folder with --out, or continue that one with {resume}")
    return old_plan


def read(path: Path, schema: type[P], limit: int = MAX_BYTES, check: Callable[[P], object] = lambda plan: None) -> P:
    """Returns the plan in a file, which is untrusted.

    Args:
        path: the file.
        schema: class of the plan.
        limit: of its size, in bytes.
        check: raises ``ValueError`` or ``TypeError`` for an invalid plan.

    Raises:
        FileNotFoundError: if it is not there.
        CheckpointError: if it is damaged or invalid.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path.parent} is no folder of an experiment: it holds no {path.name}")
    try:
        plan = convert(read_json(path, limit), schema)
        check(plan)
        return plan
    except (ValueError, TypeError) as error:
        raise CheckpointError(f"{path} is damaged: {shown(error, 1000)}") from None
