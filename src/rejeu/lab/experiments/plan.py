"""Plans of sweeps: a TOML file, or the same as a dict, becomes a list of checked jobs.

Nothing that a plan names is imported. A mistake is one line that says where it is.
"""

from __future__ import annotations

import itertools
import json
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import gymnasium as gym
from msgspec import Meta

from rejeu.agents import AGENTS, find_agent, find_preset
from rejeu.checkpoints.agent_state import Identity
from rejeu.core import devices, spaces
from rejeu.core.errors import one_line
from rejeu.core.records import MAX_DEPTH, Seed, convert, is_deep, read_bytes, shown
from rejeu.core.validation import as_path, check_names, choice, field_names
from rejeu.envs.make import BACKENDS, make_vector
from rejeu.envs.registry import are_plain, is_plain_id, maker, register
from rejeu.lab.experiments.folder import MAX_JOBS, Plan, Resources
from rejeu.lab.experiments.work import FILES, Job, job_name
from rejeu.lab.runs.begin import decide
from rejeu.lab.runs.config import RunConfig, options
from rejeu.logs.logging import check_logs, require
from rejeu.logs.tables import flat

MAX_BYTES = 2**16
"""Upper limit on the size of a plan."""
MAX_DOTS = 1000
"""Upper limit on the dots of one of its lines: a key ``a.b.c`` of 30,000 parts takes gigabytes to be read."""
OWN_OF_JOBS = ("env", "env_kwargs", "wrappers", "imports", "algorithm", "seed", "hyperparameters")
"""Fields of a run that a plan names in another way, or not at all."""
SHARED = [option for option in options(RunConfig) if option.field not in OWN_OF_JOBS]
OF_RUNS = {option.shown.name or option.field: option.field for option in SHARED}
"""Fields of a run by the names of their options, which are those of ``rejeu train``."""
OPTIONS = (*OF_RUNS, *FILES)
"""All options of the runs of a plan."""

Algorithms = str | Annotated[tuple[str, ...], Meta(min_length=1)]
Kwargs = dict[str, Any]


class PlanError(ValueError):
    """A plan is invalid. The message has the file, the place, what was received and what was expected."""


@dataclass(frozen=True, kw_only=True)
class Environments:
    """Entries of a plan about one environment, or about all, besides the options of their runs."""

    id: str | None = None
    algorithms: Algorithms | None = None
    env_kwargs: Kwargs = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Content:
    """Entries of a plan besides the options of its runs."""

    environments: Algorithms | dict[str, Kwargs]
    """Ids, or tables of :class:`Environments` and options."""
    algorithms: Algorithms | None = None
    env_kwargs: Kwargs = field(default_factory=dict)
    settings: Annotated[dict[str, Kwargs], Meta(min_length=1)] = field(default_factory=lambda: {"": {}})
    """Hyperparameters, those of one algorithm in a table of its name; ``algorithms`` says for which."""
    seeds: Annotated[int, Meta(ge=1, le=1000)] | Annotated[tuple[Seed, ...], Meta(min_length=1)] = 1
    first_seed: Annotated[int, Meta(ge=0, le=2**32 - 1 - MAX_JOBS)] | None = None
    threads: Annotated[int, Meta(ge=1, le=1024)] | None = None
    resources: Kwargs = field(default_factory=dict)


class PlannedEnvironment(NamedTuple):
    """An environment of a plan, and its spaces."""

    label: str
    run: RunConfig
    """Description that its runs have in common."""
    files: dict[str, bool]
    """Options about the files of the runs."""
    algorithms: tuple[str | None, ...]
    observation: gym.Space
    action: gym.Space


@contextmanager
def at(plan: object, *keys: str) -> Iterator[None]:
    """Context in which an invalid value becomes a :class:`PlanError` with its keys, such as ``plan.toml, settings.fast``."""
    try:
        yield
    except PlanError:
        raise
    except (ValueError, TypeError, ArithmeticError, ImportError, OSError, gym.error.Error, AssertionError) as error:
        where = f"{plan}, {'.'.join(keys)}" if keys else plan
        raise PlanError(f"{where}: {shown(one_line(error), 1000)}") from None


def read_plan(plan: str | Path | Mapping[str, Any]) -> tuple[Plan, str | None]:
    """Returns a checked plan, and its text if it is a file.

    Args:
        plan: path of a TOML file, or its content as a dict.

    Raises:
        PlanError: for a mistake, with its place.
        OSError: if the file cannot be read.
    """
    if isinstance(plan, Mapping):
        return parse(plan, "plan"), None
    path = as_path(plan)
    if not path.is_file():
        raise FileNotFoundError(f"there is no plan {path}")
    with at(path):
        try:
            text = read_bytes(path, MAX_BYTES).decode("utf-8-sig").replace("\r\n", "\n")
            if any(line.count(".") > MAX_DOTS for line in text.split("\n")):
                raise ValueError(f"it has a line of more than {MAX_DOTS:,} dots")
            content = tomllib.loads(text)
            if is_deep(content, MAX_DEPTH):
                raise RecursionError("it is nested too deeply")
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{str(error)[:200]}; expected TOML, such as steps = 20000") from None
    return parse(content, str(path)), text


def parse(content: Mapping[str, object], plan: str) -> Plan:
    """Returns the jobs of a plan: environments x algorithms x settings x seeds.

    Args:
        content: as in the file.
        plan: its name in messages.

    Raises:
        PlanError: for a mistake.
    """
    with at(plan):
        json.dumps(content, allow_nan=False)  # a date or NaN is no value of a run
        check_names(content, (*field_names(Content), *OPTIONS), "a plan")
        if not content.get("environments"):
            raise ValueError("a plan needs environments = ['Pendulum-v1', ...]")
        entries = convert({key: value for key, value in content.items() if key not in OPTIONS}, Content)
        common = {key: value for key, value in content.items() if key in OPTIONS}
        seeds = seeds_of(entries)
        read_run("", {}, common)
    with at(plan, "resources"):
        check_names(entries.resources, field_names(Resources), "resources")
        resources = convert(entries.resources, Resources)
    environments = list(read_environments(entries, common, plan))
    count = sum(len(environment.algorithms) for environment in environments) * len(entries.settings) * len(seeds)
    with at(plan):
        if count > MAX_JOBS:
            raise ValueError(f"there are {count:,} runs, expected up to {MAX_JOBS:,}")
        jobs: dict[str, Job] = {}
        for job in expanded(environments, entries.settings, seeds, plan):
            if jobs.setdefault(job.name.lower(), job) is not job:
                raise ValueError(f"two runs would be called {job.name}; give settings and environments other names")
        if not jobs:
            raise ValueError("there is nothing to train; does every setting exclude every algorithm?")
        require({log: None for job in jobs.values() for log in job.run.log})
    return Plan(jobs=tuple(jobs.values()), threads=entries.threads, resources=resources)


def expanded(
    environments: list[PlannedEnvironment], settings: Mapping[str, Kwargs], seeds: list[int], plan: str
) -> Iterator[Job]:
    """Yields the job of each combination, after all values were checked, and then that each agent can be built.

    Values take little time, so that a mistake at the end of a long plan is found at once.
    """
    checked = []
    for environment in environments:
        for algorithm, (name, setting) in itertools.product(environment.algorithms, settings.items()):
            keys = ("settings", name) if setting else ("environments", environment.label)
            with at(plan, *keys):
                if "algorithms" in setting and algorithm not in read_algorithms(setting["algorithms"]):
                    continue
                common = {key: value for key, value in setting.items() if key != "algorithms" and key not in AGENTS}
                values = {**common, **convert(setting.get(str(algorithm), {}), Kwargs)}
                run = replace(environment.run, algorithm=algorithm, hyperparameters=dict(flat(values)))
                preset = find_preset(run.env, algorithm, None if run.preset is None else str(run.preset))
                is_long = run.is_long and not any(settings.values())  # one algorithm for all settings
                _, config = decide(run, preset, environment.observation, environment.action, is_long)
            checked.append((environment, keys, name, config, replace(run, algorithm=config.name)))
    for environment, keys, name, config, run in checked:
        with at(plan, *keys):
            check_spaces(environment, config)
        for seed in seeds:
            job = job_name(environment.label, config.name, name, seed)
            yield Job(name=job, run=replace(run, seed=seed), setting=name, **environment.files)


def read_run(env_id: str, kwargs: Kwargs, options: Kwargs) -> tuple[RunConfig, dict[str, bool]]:
    """Returns a run with options, whole numbers of which may be written as 1e6, and the options about its files.

    Raises:
        ValueError, TypeError: for an invalid value.
    """
    values: Kwargs = {
        OF_RUNS.get(key, key): int(value) if isinstance(value, float) and value.is_integer() else value
        for key, value in options.items()
    }
    if isinstance(values.get("log"), str | tuple | list):
        values["log"] = check_logs("log", values["log"])
    files = convert({key: values.pop(key) for key in FILES if key in values}, dict[str, bool])
    run = convert({"env": env_id, "env_kwargs": kwargs, **values}, RunConfig)
    choice("backend", run.backend or "auto", BACKENDS)
    choice("device", run.device, devices.NAMES)
    if isinstance(run.preset, bool):
        raise TypeError(f"preset={run.preset} must be the path of a file")
    return run, files


def read_algorithms(value: object) -> tuple[str, ...]:
    """Returns the names of algorithms.

    Raises:
        ValueError: for an unknown one, with the nearest, or one that is named twice.
    """
    names: Any = convert(value, Algorithms)  # type: ignore[arg-type]
    names = (names,) if isinstance(names, str) else names
    algorithms = tuple(find_agent(name, is_typed=False).algorithm.Config.name for name in names)
    if len({*algorithms}) < len(algorithms):
        raise ValueError(f"algorithms={shown(algorithms)} names one twice")
    return algorithms


def read_environments(content: Content, common: Kwargs, plan: str) -> Iterator[PlannedEnvironment]:
    """Yields the environments of a plan: a list of ids, or a table of tables with options of their own."""
    tables = content.environments
    with at(plan, "algorithms"):
        algorithms = (None,) if content.algorithms is None else read_algorithms(content.algorithms)
    with at(plan, "environments"):
        if not isinstance(tables, dict):
            ids = (tables,) if isinstance(tables, str) else tables
            if len({*ids}) < len(ids):
                raise ValueError(f"environments={shown(ids)} names one twice")
            tables = {env_id: {} for env_id in ids}
    for label, table in tables.items():
        with at(plan, "environments", label):
            check_names(table, (*field_names(Environments), *OPTIONS), f"the environment {label}")
            table_options = {key: value for key, value in table.items() if key in OPTIONS}
            entries = convert({key: value for key, value in table.items() if key not in table_options}, Environments)
            env_id = entries.id or label
            if not is_plain_id(env_id):
                raise ValueError(
                    f"{shown(env_id)} is not the id of an environment, and no file may name a module; import it on the "
                    "command line, rejeu sweep PLAN --import MODULE, and write its id here"
                )
            kwargs = {**content.env_kwargs, **entries.env_kwargs}
            for key, value in kwargs.items():
                if not are_plain({key: value}):
                    raise ValueError(f"{key}={shown(value)} must be a number up to a million, a word, true or false")
            dropped = ("steps", "minutes") if table_options.keys() & {"steps", "minutes"} else ()
            options = {key: value for key, value in common.items() if key not in dropped} | table_options
            run, files = read_run(env_id, kwargs, options)
            env_algorithms = algorithms if entries.algorithms is None else read_algorithms(entries.algorithms)
            yield PlannedEnvironment(label, run, files, env_algorithms, *find_spaces(run))


def seeds_of(content: Content) -> list[int]:
    """Returns the seeds: a list, or as many as ``seeds`` says from ``first_seed`` on."""
    seeds = content.seeds
    if isinstance(seeds, int):
        first = content.first_seed or 0
        return [*range(first, first + seeds)]
    if content.first_seed is not None:
        raise ValueError("first_seed and a list of seeds exclude each other; give one of them")
    if len({*seeds}) < len(seeds):
        raise ValueError(f"seeds={shown(seeds)} must be a number, or a list of different seeds")
    return [*seeds]


def find_spaces(run: RunConfig) -> tuple[gym.Space, gym.Space]:
    """Makes an environment once, and returns its spaces of observations and actions."""
    if register(run.env):
        env: Any = maker(run.env, **run.env_kwargs)()
    else:
        env = make_vector(run.env, 1, "envpool" if run.backend == "envpool" else "auto", **run.env_kwargs)
    try:
        return env.observation_space, env.action_space
    finally:
        env.close()


def check_spaces(environment: PlannedEnvironment, config: Any) -> None:
    """Builds the algorithm for the spaces of an environment.

    Raises:
        ValueError, TypeError: if it does not take such spaces.
    """
    agent_class = AGENTS[config.name]
    nested = isinstance(environment.observation, gym.spaces.Dict | gym.spaces.Tuple)
    agent = agent_class.__new__(agent_class)
    agent.configure(config, Identity.of("MultiInputPolicy" if nested else "MlpPolicy", seed=0))
    agent.build(environment.observation, environment.action)
    if getattr(config, "hindsight", None) is not None:
        spaces.check_goal_space(environment.observation)
