"""The jobs of a sweep as data: what each run is, and the command line that trains it."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Annotated, Any

from msgspec import Meta

from rejeu import devices
from rejeu.cli import settings
from rejeu.cli.settings import INTEGERS
from rejeu.envs.make import BACKENDS
from rejeu.envs.registry import are_plain, is_plain_id
from rejeu.errors import CheckpointError
from rejeu.io.records import Seed
from rejeu.reporting.logging import check_logs
from rejeu.reporting.text import quoted
from rejeu.validation import assign, choice, coerce, flag, number, whole

MAX_JOBS = 10_000
"""Most runs of a sweep."""
MAX_NAME = 150
"""Most characters of the name of a job, which is also that of a folder."""
AGAIN = ("restart_workers", "ray", "env_cpus", "no_report", "no_video")
"""Options that a run does not keep, so that ``rejeu resume`` needs them again."""
Name = Annotated[str, Meta(pattern=rf"^\w[\w.-]{{0,{MAX_NAME - 1}}}\Z")]
Setting = Annotated[str, Meta(pattern=r"^[A-Za-z_][\w.]{0,199}\Z")]


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of ``rejeu train``, by the same names; None is its default."""

    preset: str | None = None
    """Path of a preset file."""
    steps: int | None = None
    minutes: float | None = None
    envs: int | None = None
    backend: str | None = None
    restart_workers: int = 0
    wait_for: int | None = None
    arrivals: str | None = None
    """Path of the record of an earlier run."""
    device: str = "auto"
    ray: str | None = None
    """``"auto"``: environments with ``backend="ray"`` are on the Ray cluster of this machine, or of ``RAY_ADDRESS``."""
    env_cpus: float | None = None
    success_threshold: float | None = None
    video_every: int | None = None
    checkpoint_minutes: float = 5.0
    evaluate_every: int | None = None
    evaluate_episodes: int | None = None
    no_report: bool = False
    no_video: bool = False
    log: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for key in ("steps", "envs", "video_every", "evaluate_every", "evaluate_episodes"):
            coerce(self, key, whole, optional=True, least=INTEGERS[key][0], most=INTEGERS[key][1])
        coerce(self, "wait_for", whole, optional=True, least=1)
        coerce(self, "env_cpus", number, optional=True, least=0, most=10_000)
        coerce(self, "restart_workers", whole, least=0)
        coerce(self, "minutes", number, optional=True, above=0)
        coerce(self, "success_threshold", number, optional=True)
        coerce(self, "checkpoint_minutes", number, least=0)
        coerce(self, ("no_report", "no_video"), flag)
        for key in ("preset", "arrivals"):
            value = getattr(self, key)
            if value is not None and (not isinstance(value, str) or not value or value.startswith("-")):
                raise ValueError(f"{key}={value!r} must be the path of a file")
        if self.ray not in (None, "auto"):
            raise ValueError(
                f"ray={self.ray!r} must be 'auto': no file may name what is connected to; set RAY_ADDRESS=HOST:PORT"
            )
        coerce(self, "backend", choice, optional=True, among=BACKENDS)
        coerce(self, "device", choice, among=devices.NAMES)
        if not isinstance(self.log, str | list | tuple) or not all(isinstance(one, str) for one in self.log):
            raise TypeError(f"log={self.log!r} must be a list of names")
        assign(self, log=check_logs("log", self.log))
        if self.steps is not None and self.minutes is not None:
            raise ValueError(f"steps={self.steps} and minutes={self.minutes:g} exclude each other; give one of them")


@dataclass(frozen=True, kw_only=True)
class Code:
    """What the command line names for import. No file may name it."""

    env: str | None = None
    """The environment, as typed."""
    wrappers: tuple[str, ...] = ()
    """Wrappers, innermost first."""
    imports: tuple[str, ...] = ()
    """Modules and files that are imported first."""

    def words(self) -> list[str]:
        """Returns the options of the command line that import modules."""
        return [*chain.from_iterable(("--import", name) for name in self.imports)]


@dataclass(frozen=True, kw_only=True)
class Job:
    """One run of a sweep."""

    name: Name
    """Of its folder, its log and its locks."""
    env: Annotated[str, Meta(pattern=r"^[^-\s][^\r\n]{0,299}\Z")]
    """Environment, as for ``rejeu train``."""
    seed: Seed
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    wrappers: tuple[str, ...] = ()
    """Wrappers of the environment, innermost first."""
    algorithm: Annotated[str, Meta(pattern=r"^\w[\w-]{0,99}\Z")] | None = None
    """None for the preset's, or the one that fits the environment."""
    setting: str = ""
    """Name of the hyperparameters."""
    hyperparameters: dict[Setting, Any] = field(default_factory=dict)
    """Hyperparameters that differ from the preset's, by dotted name, as JSON values."""
    options: Options = field(default_factory=Options)

    @property
    def names_code(self) -> bool:
        """Whether its environment is imported, or made with more than numbers and words."""
        return not is_plain_id(self.env) or self.env.endswith(".py") or bool(self.wrappers) or not self.has_plain_kwargs

    @property
    def has_plain_kwargs(self) -> bool:
        """Whether a file may give these keyword arguments of the environment."""
        return are_plain(self.env_kwargs)

    def environment_words(self) -> list[str]:
        """Returns the options of the command line that make the environment, without its id."""
        words = assignments("--env-kwargs", self.env_kwargs)
        return [*words, *chain.from_iterable(("--wrapper", name) for name in self.wrappers)]

    def train_words(self, out: str, code: Code) -> list[str]:
        """Returns the command line that begins the run in the folder ``out``, without ``rejeu``."""
        words = ["train", self.env, *code.words(), *self.environment_words()]
        words += [] if self.algorithm is None else ["--algo", self.algorithm]
        words += [*option_words(self.options), *assignments("--set", self.hyperparameters)]
        return [*words, "--seed", str(self.seed), "--out", out]

    def resume_words(self, run: str, code: Code) -> list[str]:
        """Returns the command line that continues the run, or completes its files, without ``rejeu``."""
        words = ["resume", run, "--finish", *code.words()]
        again = {name: getattr(self.options, name) for name in AGAIN}
        words += option_words(Options(**again))
        return [*words, "--env", self.env, *self.environment_words()] if self.names_code else words

    def check_code(self, code: Code, where: object) -> None:
        """Raises ``CheckpointError`` if the job imports something that the command line does not name."""
        if not self.names_code or (self.env == code.env and self.wrappers == code.wrappers):
            return
        options = "".join(f" --wrapper {quoted(name)}" for name in self.wrappers)
        raise CheckpointError(
            f"{where} names an environment that is imported or made with more than numbers, which no file may ask for; "
            f"if you trust it, name it again: --env {quoted(self.env)}{options}"
        )


def again(jobs: Iterable[Job], code: Code) -> str:
    """Returns the options with which ``rejeu resume`` imports what jobs need, with a space before each.

    >>> again([Job(name="seed_0", env="my_env.py", seed=0)], Code(env="my_env.py"))
    ' --env my_env.py'
    """
    job = next((job for job in jobs if job.names_code), None)
    words = [] if job is None else ["--env", job.env, *job.environment_words()]
    return "".join(f" {quoted(word)}" for word in [*words, *code.words()])


def assignments(option: str, values: Mapping[str, Any]) -> list[str]:
    """Returns values as an option of the command line.

    >>> assignments("--set", {"gamma": 0.9, "policy_kwargs.net_arch": [8]})
    ['--set', 'gamma=0.9', 'policy_kwargs.net_arch=[8]']
    """
    return [option, *(f"{name}={settings.written(value)}" for name, value in values.items())] if values else []


def option_words(options: Options) -> list[str]:
    """Returns the options that differ from the defaults, as words of the command line.

    >>> option_words(Options(steps=100, no_report=True, log=("json",)))
    ['--steps', '100', '--no-report', '--log', 'json']
    """
    words: list[str] = []
    for one in dataclasses.fields(options):
        value = getattr(options, one.name)
        if value == one.default:
            continue
        words.append(f"--{one.name.replace('_', '-')}")
        if one.name == "log":
            words += value
        elif value is not True:
            words.append(str(value))
    return words


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
