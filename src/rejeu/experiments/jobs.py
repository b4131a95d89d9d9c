"""The jobs of a sweep as data."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from rejeu.envs.registry import are_plain
from rejeu.errors import CheckpointError
from rejeu.io.records import Malformed
from rejeu.runs.config import RENAMED, RunConfig, Task
from rejeu.runs.values import written
from rejeu.validation import assign, coerce, number

MAX_JOBS = 10_000
"""Most runs of a sweep."""
MAX_NAME = 150
"""Most characters of the name of a job, which is also that of a folder."""
UNITS = {"": 1, "B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
Name = Annotated[str, Meta(pattern=rf"^\w[\w.-]{{0,{MAX_NAME - 1}}}\Z")]
FILES = ("no_report", "no_video")
"""Options about the files of a job, which its run does not keep."""


@dataclass(frozen=True, kw_only=True)
class Resources:
    """What one run needs on a node of a Ray cluster; Ray starts no more runs on a node than fit."""

    cpus: float = 1
    """Processor cores."""
    gpus: float = 0
    """GPUs; a fraction shares one."""
    memory: int | str | None = None
    """Memory in bytes, or as ``"4 GB"``; None reserves none."""
    custom: dict[str, float] = field(default_factory=dict)
    """Ray's custom resources by name."""

    def __post_init__(self) -> None:
        coerce(self, "cpus", number, above=0, most=10_000)
        coerce(self, "gpus", number, least=0, most=1000)
        assign(self, memory=None if self.memory is None else memory_bytes(self.memory))
        if not isinstance(self.custom, Mapping) or len(self.custom) > 100:
            raise TypeError(f"custom={self.custom!r} must be a table of up to 100 numbers")
        assign(self, custom={str(key): number(f"custom.{key}", value, above=0) for key, value in self.custom.items()})


def memory_bytes(value: Any) -> int:
    """Returns an amount of memory in bytes.

    Raises:
        ValueError: if it is none.

    >>> memory_bytes("1.5 GB"), memory_bytes(1000)
    (1500000000, 1000)
    """
    found = re.fullmatch(r"(\d{1,15}(?:\.\d{1,6})?) ?([KMGT]?B)?", str(value))
    if isinstance(value, bool) or found is None or float(found[1]) <= 0:
        raise ValueError(f"memory={value!r} must be a number of bytes, or a text such as '4 GB'")
    return int(float(found[1]) * UNITS[found[2] or ""])


@dataclass(frozen=True, kw_only=True)
class Job:
    """One run of a sweep."""

    name: Name
    """Of its folder, its log and its locks."""
    run: RunConfig
    """Its description; what it imports is named on the command line of the sweep."""
    setting: str = ""
    """Name of the hyperparameters."""
    no_report: bool = False
    no_video: bool = False

    def __post_init__(self) -> None:
        if self.run.seed is None:
            raise ValueError(f"the job {self.name} has no seed")
        if self.run.env_argument or self.run.imports:
            raise ValueError(f"the job {self.name} names what is imported, which no file may do")
        if self.run.ray not in (None, "auto"):
            raise ValueError(
                f"ray={self.run.ray!r} must be 'auto': no file may name what is connected to; set RAY_ADDRESS=HOST:PORT"
            )

    @property
    def seed(self) -> int:
        """Seed of the run."""
        assert self.run.seed is not None
        return self.run.seed

    def task(self, folder: Path, resume: bool, imports: tuple[str, ...]) -> Task:
        """Returns what a process is asked to do: to begin the run in a folder, or to continue it there."""
        run = replace(self.run, imports=imports)
        return Task(folder=str(folder), run=run, resume=resume, no_report=self.no_report, no_video=self.no_video)

    def check_code(self, typed: RunConfig, where: object) -> None:
        """Raises ``CheckpointError`` if the job imports something that the command line does not name."""
        kwargs, of_line = ({key: written(one) for key, one in run.env_kwargs.items()} for run in (self.run, typed))
        is_named = self.run.env == typed.env and self.run.wrappers == typed.wrappers and kwargs == (of_line or kwargs)
        if not self.run.names_code or (is_named and (of_line or are_plain(self.run.env_kwargs))):
            return
        options = again([self], RunConfig(env=""))
        raise CheckpointError(
            f"{where} names an environment that is imported or made with more than numbers, which no file may ask for; "
            f"if you trust it, name it again:{options if len(options) < 500 and options.isprintable() else ' --env ENV'}"
        )


def from_file(content: Any) -> Any:
    """Returns a job of a ``sweep.json`` in the present form; earlier versions wrote the run between the fields of the job."""
    if not isinstance(content, dict) or "run" in content:
        return content
    options = content.get("options", {})
    if not isinstance(options, dict):
        raise Malformed("the options of a job are no table")
    own = {one.name for one in fields(Job)}
    run = {RENAMED.get(key, key): one for key, one in {**options, **content}.items() if key not in {*own, "options"}}
    return {key: one for key, one in {**options, **content, "run": run}.items() if key in own}


def again(jobs: Iterable[Job], typed: RunConfig) -> str:
    """Returns the options with which ``rejeu resume`` imports what jobs need, with a space before each.

    >>> again([Job(name="a", run=RunConfig(env="my_env.py", seed=0))], RunConfig(env="my_env.py"))
    ' --env my_env.py'
    >>> again([Job(name="a", run=RunConfig(env="CartPole-v1", seed=0))], RunConfig(env="", imports=("a.py",)))
    ' --import a.py'
    """
    run = next((job.run for job in jobs if job.run.names_code), RunConfig(env="plain"))
    return replace(run, imports=typed.imports).again()


def flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yields the values of a nested mapping by dotted name.

    >>> dict(flat({"gamma": 0.9, "policy_kwargs": {"net_arch": [8]}}))
    {'gamma': 0.9, 'policy_kwargs.net_arch': [8]}
    """
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def job_name(*parts: object) -> str:
    """Returns a readable name for a run and its folder.

    >>> job_name("ALE/Pong-v5", "DQN", "", 3)
    'ALE-Pong-v5-DQN-seed3'
    """
    *labels, seed = parts
    text = "-".join(str(one) for one in labels if one)
    return f"{re.sub(r'[^A-Za-z0-9_.]+', '-', text).strip('-.')[: MAX_NAME - 20]}-seed{seed}"
